//! Triangle meshes and clouds of surface points, and their files.
//!
//! What it refuses to know: where meshes come from, and what they are judged by.

mod glb;
#[cfg(test)]
mod tests;

use std::path::Path;

use glam::Vec3;

use crate::{SceneError, ply};

/// A surface of triangles that share vertices; a cloud of points of a surface where there are no
/// triangles. World frame, world units (metres).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    /// World positions, `[vertices]` of xyz, finite.
    pub positions: Vec<[f32; 3]>,
    /// Unit normals on the outer side, `[vertices]`, or empty; zero where one is not known.
    pub normals: Vec<[f32; 3]>,
    /// 8-bit sRGB, `[vertices]`, or empty.
    pub rgb: Vec<[u8; 3]>,
    /// Indices of three vertices each, counter-clockwise as seen from the outer side.
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// Reads a PLY, ascii or binary little-endian, numbers of any type, other properties skipped.
    /// Faces of more corners become fans of triangles (right where they are convex). A file without
    /// faces gives a cloud of points: `triangles` is empty. Refused: positions that are not finite,
    /// indices of vertices that do not exist. Coordinates become 32-bit: files whose origin is far
    /// away (UTM) lose precision.
    pub fn read(path: &Path) -> Result<Self, SceneError> {
        ply::read_mesh(path)
    }

    /// Writes, atomically, what the path's extension says: `.ply` (binary little-endian) or `.glb`
    /// (glTF 2.0, see [`Mesh::write_glb`]).
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

    /// Writes a binary glTF 2.0, atomically. The world's z axis is taken for up, as in the drone scenes;
    /// a rotation of the node turns it to glTF's y.
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
        assert!([0, vertices].contains(&self.normals.len()), "{} normals", self.normals.len());
        assert!([0, vertices].contains(&self.rgb.len()), "{} colours", self.rgb.len());
    }
}
