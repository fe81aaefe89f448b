//! The town's triangles with their materials, and the basic shapes that all objects consist of.

use glam::{Vec2, Vec3};

use super::material::Material;

/// Triangles of less than a square millimetre are dropped: those with `(2 · area)²` below this, m⁴.
const AREA_MIN: f32 = 4e-12;

/// A triangle of the town.
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

/// A local coordinate frame to build in; z is up.
#[derive(Clone, Copy, Debug)]
pub(super) struct Frame {
    pub(super) origin: Vec3,
    /// Unit, horizontal.
    pub(super) x: Vec3,
    /// Unit, horizontal, to the left of x.
    pub(super) y: Vec3,
}

impl Frame {
    /// The world position of local coordinates.
    pub(super) fn at(&self, x: f32, y: f32, z: f32) -> Vec3 {
        self.origin + self.x * x + self.y * y + Vec3::Z * z
    }

    /// This frame with its origin moved by a local offset.
    pub(super) fn moved(&self, x: f32, y: f32, z: f32) -> Self {
        Self { origin: self.at(x, y, z), ..*self }
    }

    /// This frame rotated so that its x axis has the local direction `along` (of any non-zero length).
    pub(super) fn turned(&self, along: Vec2) -> Self {
        let a = along.normalize();
        Self { x: self.x * a.x + self.y * a.y, y: self.y * a.x - self.x * a.y, ..*self }
    }
}

/// A box in a frame's coordinates.
#[derive(Clone, Copy, Debug)]
pub(super) struct Block3 {
    pub(super) min: Vec3,
    pub(super) max: Vec3,
}

impl Block3 {
    /// A box of `size` that stands at height `z_min`, centred at `(x, y)`.
    pub(super) fn standing(x: f32, y: f32, z_min: f32, size: Vec3) -> Self {
        let half = Vec3::new(0.5 * size.x, 0.5 * size.y, 0.0);
        let foot = Vec3::new(x, y, z_min);
        Self { min: foot - half, max: foot + half + Vec3::Z * size.z }
    }
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

/// Corners of a regular polygon on the unit circle, counter-clockwise from the x axis.
pub(super) fn regular_polygon(sides: usize) -> Vec<Vec2> {
    (0..sides).map(|i| unit_circle(i as f32 / sides as f32)).collect()
}

/// The point of the unit circle at `turns` full turns from the x axis, with an error of at most 1e-3
/// turns along the circle. Uses polynomials only, as sines differ between platforms.
pub(super) fn unit_circle(turns: f32) -> Vec2 {
    let quarter = (turns - super::random::floor_i32(turns) as f32) * 4.0;
    let whole = super::random::floor_i32(quarter);
    // Series of sine and cosine around the middle of the quarter turn, then normalised.
    let t = (quarter - whole as f32 - 0.5) * std::f32::consts::FRAC_PI_2;
    let (sine, cosine) = (t - t * t * t * (1.0 / 6.0), 1.0 - 0.5 * t * t + t * t * t * t * (1.0 / 24.0));
    let half = std::f32::consts::FRAC_1_SQRT_2;
    let p = Vec2::new(half * (cosine - sine), half * (cosine + sine)).normalize();
    match whole {
        0 => p,
        1 => Vec2::new(-p.y, p.x),
        2 => -p,
        _ => Vec2::new(p.y, -p.x),
    }
}
