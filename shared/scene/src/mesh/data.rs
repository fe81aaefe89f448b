//! The vertices and triangles of a mesh.

use glam::Vec3;

/// A mesh of triangles that share vertices, or a cloud of surface points if `triangles` is empty.
/// World frame, world units (metres).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    /// World positions, `[vertices]` of xyz, finite.
    pub positions: Vec<[f32; 3]>,
    /// Unit normals that point outwards, `[vertices]`, or empty; a normal of zero is unknown.
    pub normals: Vec<[f32; 3]>,
    /// Colours in 8-bit sRGB, `[vertices]`, or empty.
    pub rgb: Vec<[u8; 3]>,
    /// The three vertex indices of each triangle, counter-clockwise as seen from the outer side.
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
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

    /// Panics if some vertices have a normal and others have none; the same for colours.
    pub(super) fn assert_whole(&self) {
        let vertices = self.positions.len();
        let (normals, colors) = (self.normals.len(), self.rgb.len());
        assert!([0, vertices].contains(&normals), "{normals} normals of {vertices} vertices");
        assert!([0, vertices].contains(&colors), "{colors} colours of {vertices} vertices");
    }
}
