//! Makes a mesh from rendered depth: fuses truncated signed distances in a sparse volume of small blocks
//! (Curless and Levoy 1996; blocks as in Nießner et al. 2013), then extracts triangles by marching cubes.
//!
//! A first pass over smaller pictures determines the size of voxels and finds the blocks that the surface passes
//! through. Then as many blocks as fit are allocated at once, the views are fused into them one after the other, and their
//! triangles are added to the mesh; then the next blocks. Each view is fused into all blocks in parallel, so the mesh has
//! the same bytes for any number of threads, and for any division of the blocks. If the memory is too small for the mesh
//! with the wanted voxels, the voxels become larger; [`mesh_to_ply`] needs a seventh of the memory for the mesh, because
//! it keeps it in files. [`mesh_file`] refuses a memory limit that is too small for any mesh.
//!
//! What it knows nothing about: how views are rendered. [`fuse()`] takes a [`Painter`]; only [`mesh_file`] knows a
//! renderer.
//!
//! Where to start reading: [`fuse()`], then `volume`, `extract` and `parts`. [`mesh_file`] renders a splat model and fuses
//! the renderings.

mod budget;
mod cases;
mod clean;
mod decimate;
mod error;
mod event;
mod extract;
mod files;
mod frame;
mod fuse;
mod keeper;
mod model;
mod painter;
mod parts;
mod scout;
#[cfg(test)]
mod tests;
mod volume;

pub use decimate::decimate;
pub use error::MeshError;
pub use event::{FuseEvent, Stage};
pub use fuse::{FuseSettings, Fused, fuse};
pub(crate) use model::render_each;
pub use model::{MeshSource, mesh_file, mesh_to_ply};
pub use painter::Painter;
