//! The geometry that objects are built from: local frames, boxes in them and points of the unit circle.

use glam::{Vec2, Vec3};

use super::random::floor_i32;

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

/// Corners of a regular polygon on the unit circle, counter-clockwise from the x axis.
pub(super) fn regular_polygon(sides: usize) -> Vec<Vec2> {
    (0..sides).map(|i| unit_circle(i as f32 / sides as f32)).collect()
}

/// The point of the unit circle at `turns` full turns from the x axis, with an error of at most 1e-3
/// turns along the circle. Uses polynomials only, as sines differ between platforms.
pub(super) fn unit_circle(turns: f32) -> Vec2 {
    let quarter = (turns - floor_i32(turns) as f32) * 4.0;
    let whole = floor_i32(quarter);
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
