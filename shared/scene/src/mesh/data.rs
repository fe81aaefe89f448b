//! The vertices and triangles of a mesh.

use glam::{DVec3, Vec3};

use crate::LocalFrame;

/// A mesh of triangles that share vertices, or a cloud of surface points if `triangles` is empty.
/// Axes and units (metres) are the world's.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    /// The world position that `positions` are relative to, as an `f32` is too coarse far from the world's origin.
    pub origin: DVec3,
    /// Positions, `[vertices]` of xyz, finite.
    pub positions: Vec<[f32; 3]>,
    /// Unit normals that point outwards, `[vertices]`, or empty; a normal of zero is unknown.
    pub normals: Vec<[f32; 3]>,
    /// Colours in 8-bit sRGB, `[vertices]`, or empty.
    pub rgb: Vec<[u8; 3]>,
    /// The three vertex indices of each triangle, counter-clockwise as seen from the outer side.
    pub triangles: Vec<[u32; 3]>,
}

/// How many vertices and triangles a mesh has.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MeshCounts {
    /// Number of vertices.
    pub vertices: u64,
    /// Number of triangles.
    pub triangles: u64,
}

impl Mesh {
    /// How many vertices and triangles there are.
    pub fn counts(&self) -> MeshCounts {
        MeshCounts { vertices: self.positions.len() as u64, triangles: self.triangles.len() as u64 }
    }

    /// Positions of the corners of triangle `i`.
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

    /// Makes the positions relative to another world position.
    pub fn move_origin(&mut self, origin: DVec3) {
        let (from, to) = (LocalFrame::at(self.origin), LocalFrame::at(origin));
        self.positions.iter_mut().for_each(|position| *position = from.moved(*position, &to));
        self.origin = origin;
    }

    /// Maps the world's mesh into a local frame, whose units its positions then have.
    pub fn into_frame(mut self, frame: &LocalFrame) -> Self {
        let from = LocalFrame::at(std::mem::take(&mut self.origin));
        self.positions.iter_mut().for_each(|position| *position = from.moved(*position, frame));
        self
    }

    /// Maps a mesh with positions in a local frame into the world, relative to the frame's origin.
    pub fn out_of_frame(mut self, frame: &LocalFrame) -> Self {
        let files = frame.of_files();
        self.positions.iter_mut().for_each(|position| *position = frame.moved(*position, &files));
        self.origin = frame.origin();
        self
    }

    /// Panics if some vertices have a normal and others have none; the same for colours.
    pub(super) fn assert_whole(&self) {
        let vertices = self.positions.len();
        let (normals, colors) = (self.normals.len(), self.rgb.len());
        assert!([0, vertices].contains(&normals), "{normals} normals of {vertices} vertices");
        assert!([0, vertices].contains(&colors), "{colors} colours of {vertices} vertices");
    }
}
