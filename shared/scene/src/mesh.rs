//! Triangle meshes and clouds of surface points, and their files.
//!
//! What it knows nothing about: how meshes are made, and how they are evaluated.

mod data;
mod glb;
mod obj;
mod ply;
#[cfg(test)]
mod tests;
mod texture;

use std::path::Path;

use crate::SceneError;
pub use data::{Mesh, MeshCounts};
pub use ply::MeshWriter;
pub use texture::Texture;

impl Mesh {
    /// Reads a PLY, ascii or binary little-endian, with numbers of any type. Properties other than positions, normals,
    /// colours and the corners of faces are skipped. A face with more than three corners becomes a fan of triangles,
    /// which is correct if the face is convex. A file without faces gives a cloud of points. Positions become `f32`;
    /// those of the type `double` far from the world's origin (UTM) are read relative to [`Mesh::origin`], others lose
    /// precision there. Errors: positions that are not finite, faces with fewer than three corners, indices of missing
    /// vertices.
    pub fn read(path: &Path) -> Result<Self, SceneError> {
        ply::read(path)
    }

    /// Writes the mesh, atomically, in the format of the path's extension: `.ply` (binary
    /// little-endian), `.glb` (glTF 2.0, see [`Mesh::write_glb`]) or `.obj` (in world coordinates). Errors: any other
    /// extension.
    pub fn write(&self, path: &Path) -> Result<(), SceneError> {
        match path.extension().and_then(|extension| extension.to_str()) {
            Some("ply") => self.write_ply(path),
            Some("glb") => self.write_glb(path, &serde_json::Map::new()),
            Some("obj") => self.write_obj(path, "x east, y north, z up where the dataset has them, metres"),
            _ => Err(SceneError::malformed(
                path,
                "meshes are written as .ply, .glb or .obj; choose one of these",
            )),
        }
    }

    /// Writes a binary little-endian PLY in world coordinates, atomically.
    pub fn write_ply(&self, path: &Path) -> Result<(), SceneError> {
        self.assert_whole();
        ply::write(path, self)
    }

    /// As [`Mesh::write_ply`], with the same bytes, for a mesh that need not be in memory as a whole; `self` is any part of it.
    /// `fill` writes all vertices, part by part, and then all triangles, as many as `counts` says. Each part must have the origin
    /// of `self`, and normals and colours if `self` has some.
    pub fn write_ply_parts<E: From<SceneError>>(
        &self,
        path: &Path,
        counts: MeshCounts,
        fill: impl FnOnce(&mut MeshWriter) -> Result<(), E>,
    ) -> Result<(), E> {
        ply::write_parts(path, self, counts, fill)
    }

    /// Writes a Wavefront OBJ in world coordinates, atomically. `comment` is its first line.
    pub fn write_obj(&self, path: &Path, comment: &str) -> Result<(), SceneError> {
        self.assert_whole();
        obj::write(path, self, None, comment)
    }

    /// As [`Mesh::write_obj`], with a texture instead of colours. Also writes its material, a file beside `path` with the
    /// extension `.mtl`, which names the picture: that must lie in the same folder. Panics unless each vertex is on the picture.
    pub fn write_textured_obj(
        &self,
        path: &Path,
        texture: &Texture,
        comment: &str,
    ) -> Result<(), SceneError> {
        self.assert_whole();
        assert_eq!(texture.uv.len(), self.positions.len(), "each vertex is on the picture");
        obj::write_material(&path.with_extension("mtl"), texture)?;
        obj::write(path, self, Some(texture), comment)
    }

    /// Writes a binary glTF 2.0 file, atomically. The world's z axis is taken as up, as in the drone scenes; a rotation
    /// of the file's node maps it to the y axis, which is up in glTF. The node also holds the origin. Without normals, viewers
    /// show the colours as they are (`KHR_materials_unlit`), because those of photographs have their light already. `extras`
    /// are written into the file's `asset`. Errors: a mesh without triangles, or a file of more than 4 GiB.
    pub fn write_glb(
        &self,
        path: &Path,
        extras: &serde_json::Map<String, serde_json::Value>,
    ) -> Result<(), SceneError> {
        self.assert_whole();
        glb::write(path, self, None, extras)
    }

    /// As [`Mesh::write_glb`], with a texture instead of colours. The picture is copied into the file. Panics unless each vertex
    /// is on the picture.
    pub fn write_textured_glb(
        &self,
        path: &Path,
        texture: &Texture,
        extras: &serde_json::Map<String, serde_json::Value>,
    ) -> Result<(), SceneError> {
        self.assert_whole();
        assert_eq!(texture.uv.len(), self.positions.len(), "each vertex is on the picture");
        glb::write(path, self, Some(texture), extras)
    }
}
