//! Triangle meshes and clouds of surface points, and their files.
//!
//! What it refuses to know: how meshes are made, and how they are evaluated.

mod glb;
#[cfg(test)]
mod tests;

use std::path::Path;

use glam::Vec3;

use crate::{SceneError, ply};

/// A mesh of triangles that share vertices, or a cloud of surface points if `triangles` is empty.
/// World frame, world units (metres).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    /// World positions, `[vertices]` of xyz, finite.
    pub positions: Vec<[f32; 3]>,
    /// Unit normals that point outwards, `[vertices]`, or empty; zero where a normal is unknown.
    pub normals: Vec<[f32; 3]>,
    /// 8-bit sRGB, `[vertices]`, or empty.
    pub rgb: Vec<[u8; 3]>,
    /// Indices of three vertices each, counter-clockwise as seen from the outer side.
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// Reads a PLY, ascii or binary little-endian, with numbers of any type; skips other properties.
    /// Larger faces become fans of triangles, which is correct for convex faces. A file without
    /// faces gives a cloud of points. Positions become `f32`, so coordinates far from the origin
    /// (UTM) lose precision. Errors: positions that are not finite, indices of missing vertices.
    pub fn read(path: &Path) -> Result<Self, SceneError> {
        ply::read_mesh(path)
    }

    /// Writes, atomically, in the format of the path's extension: `.ply` (binary little-endian) or
    /// `.glb` (glTF 2.0, see [`Mesh::write_glb`]). Errors: any other extension.
    pub fn write(&self, path: &Path) -> Result<(), SceneError> {
        match path.extension().and_then(|extension| extension.to_str()) {
            Some("ply") => self.write_ply(path),
            Some("glb") => self.write_glb(path),
            _ => Err(SceneError::malformed(path, "meshes are written as .ply or .glb; choose one of these")),
        }
    }

    /// Writes a binary little-endian PLY, atomically.
    pub fn write_ply(&self, path: &Path) -> Result<(), SceneError> {
        self.assert_whole();
        ply::write_mesh(path, self)
    }

    /// Writes a binary glTF 2.0, atomically. The world's z axis is taken as up, as in the drone scenes;
    /// the node's rotation maps it to glTF's y. Errors: no triangles, or more than 4 GiB.
    pub fn write_glb(&self, path: &Path) -> Result<(), SceneError> {
        self.assert_whole();
        glb::write(path, self)
    }

    /// World positions of the corners of triangle `i`.
    pub fn corners(&self, i: usize) -> [Vec3; 3] {
        self.triangles[i].map(|vertex| Vec3::from_array(self.positions[vertex as usize]))
    }

    /// Areas of the triangles, square world units.
    pub fn areas(&self) -> impl ExactSizeIterator<Item = f64> {
        (0..self.triangles.len()).map(|i| {
            let [a, b, c] = self.corners(i).map(|corner| corner.as_dvec3());
            0.5 * (b - a).cross(c - a).length()
        })
    }

    fn assert_whole(&self) {
        let vertices = self.positions.len();
        let (normals, colors) = (self.normals.len(), self.rgb.len());
        assert!([0, vertices].contains(&normals), "{normals} normals of {vertices} vertices");
        assert!([0, vertices].contains(&colors), "{colors} colours of {vertices} vertices");
    }
}
