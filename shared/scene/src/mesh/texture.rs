//! A picture that lies on a mesh.
//!
//! What it knows nothing about: how the picture was made; files of meshes.

use std::path::PathBuf;

/// A picture, and where the vertices of a mesh lie on it. Vertices where two pieces of the picture meet must be there twice.
#[derive(Clone, Debug, PartialEq)]
pub struct Texture {
    /// For each vertex: how far from the left edge of the picture, as a share of its width, and from the upper edge, as a
    /// share of its height, 0..=1.
    pub uv: Vec<[f32; 2]>,
    /// The picture, a JPEG file. Its colours are those to be shown: they have their light already.
    pub picture: PathBuf,
}
