//! The input of every texture, a spot on a surface, and its output, how the surface looks there.

use glam::{Vec2, Vec3};

/// The inputs of a material at a position on a surface.
#[derive(Clone, Copy, Debug)]
pub(super) struct Spot {
    /// World position, metres.
    pub(super) position: Vec3,
    /// Texture position; its unit depends on the material.
    pub(super) uv: Vec2,
    /// Distance between neighbouring samples on the surface, metres.
    pub(super) footprint_m: f32,
}

/// How a surface reflects light at one position.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Appearance {
    /// Fraction of light that is reflected diffusely, linear rgb, 0 to 1 each.
    pub(super) albedo: Vec3,
    /// Fraction of light that is mirrored at normal incidence, 0 to 1.
    pub(super) mirror: f32,
    /// Fraction of light that passes through, as through leaves, 0 to 1.
    pub(super) translucent: f32,
}

impl Appearance {
    pub(super) fn matt(albedo: Vec3) -> Self {
        Self { albedo, mirror: 0.0, translucent: 0.0 }
    }

    pub(super) fn glossy(albedo: Vec3, mirror: f32) -> Self {
        Self { albedo, mirror, translucent: 0.0 }
    }
}
