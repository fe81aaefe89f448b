//! The city's triangles with their materials, and the basic shapes that all objects consist of.

use glam::{Vec2, Vec3};

use super::material::Material;
use super::shapes::{Block3, Frame, regular_polygon};

/// Triangles of less than a square millimetre are dropped: those with `(2 · area)²` below this, m⁴.
const AREA_MIN: f32 = 4e-12;

/// A triangle of the city.
#[derive(Clone, Copy, Debug)]
pub(super) struct Triangle {
    /// World position of each corner.
    pub(super) corners: [Vec3; 3],
    /// Texture position of each corner; its unit depends on the material.
    pub(super) uvs: [Vec2; 3],
    /// Index into [`Mesh::materials`].
    pub(super) material: u32,
}

/// Triangles and the materials that they refer to.
#[derive(Debug, Default)]
pub(super) struct Mesh {
    pub(super) triangles: Vec<Triangle>,
    pub(super) materials: Vec<Material>,
}

impl Mesh {
    /// Adds a material; returns its index.
    pub(super) fn add(&mut self, material: Material) -> u32 {
        self.materials.push(material);
        self.materials.len() as u32 - 1
    }

    /// Adds a triangle unless it has hardly any area.
    pub(super) fn triangle(&mut self, corners: [Vec3; 3], uvs: [Vec2; 3], material: u32) {
        let [a, b, c] = corners;
        if (b - a).cross(c - a).length_squared() < AREA_MIN {
            return;
        }
        self.triangles.push(Triangle { corners, uvs, material });
    }

    /// Adds a quadrilateral with its corners in order.
    pub(super) fn quad(&mut self, c: [Vec3; 4], uv: [Vec2; 4], material: u32) {
        self.triangle([c[0], c[1], c[2]], [uv[0], uv[1], uv[2]], material);
        self.triangle([c[0], c[2], c[3]], [uv[0], uv[2], uv[3]], material);
    }

    /// Adds a parallelogram, given by a corner and two sides. Its texture position is in metres along the
    /// sides.
    pub(super) fn panel(&mut self, corner: Vec3, side_u: Vec3, side_v: Vec3, material: u32) {
        let (u, v) = (Vec2::X * side_u.length(), Vec2::Y * side_v.length());
        self.quad(
            [corner, corner + side_u, corner + side_u + side_v, corner + side_v],
            [Vec2::ZERO, u, u + v, v],
            material,
        );
    }

    /// Adds a box without a bottom, textured in metres.
    pub(super) fn block(&mut self, frame: &Frame, b: Block3, side: u32, top: u32) {
        let size = b.max - b.min;
        let (x, y, z) = (frame.x * size.x, frame.y * size.y, Vec3::Z * size.z);
        let low = frame.at(b.min.x, b.min.y, b.min.z);
        let high = frame.at(b.max.x, b.max.y, b.min.z);
        self.panel(low, x, z, side);
        self.panel(low + x, y, z, side);
        self.panel(high, -x, z, side);
        self.panel(high - x, -y, z, side);
        self.panel(low + z, x, y, top);
    }

    /// Adds a box with a bottom, for objects above the ground.
    pub(super) fn hanging_block(&mut self, frame: &Frame, b: Block3, material: u32) {
        self.block(frame, b, material, material);
        let size = b.max - b.min;
        self.panel(frame.at(b.min.x, b.min.y, b.min.z), frame.y * size.y, frame.x * size.x, material);
    }

    /// Adds an upright prism or truncated pyramid over a regular polygon. `radii_m` and `heights_m` are
    /// `[lower end, upper end]`, `materials` is `[sides, lid]`. A pointed top has no lid.
    pub(super) fn drum(
        &mut self,
        frame: &Frame,
        radii_m: [f32; 2],
        heights_m: [f32; 2],
        sides: usize,
        materials: [u32; 2],
    ) {
        let ring = regular_polygon(sides);
        let around = std::f32::consts::TAU * radii_m[0].max(radii_m[1]) / sides as f32;
        for i in 0..sides {
            let (a, b) = (ring[i], ring[(i + 1) % sides]);
            let at = |d: Vec2, end: usize| frame.at(d.x * radii_m[end], d.y * radii_m[end], heights_m[end]);
            let (u0, u1) = (around * i as f32, around * (i + 1) as f32);
            let rise = heights_m[1] - heights_m[0];
            self.quad(
                [at(a, 0), at(b, 0), at(b, 1), at(a, 1)],
                [Vec2::new(u0, 0.0), Vec2::new(u1, 0.0), Vec2::new(u1, rise), Vec2::new(u0, rise)],
                materials[0],
            );
            if radii_m[1] > 0.0 {
                let top = frame.at(0.0, 0.0, heights_m[1]);
                self.triangle(
                    [top, at(a, 1), at(b, 1)],
                    [Vec2::ZERO, a * radii_m[1], b * radii_m[1]],
                    materials[1],
                );
            }
        }
    }
}
