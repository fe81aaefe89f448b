//! Smooth noise of known wavelengths, so that textures can omit detail that a pixel cannot show.

use glam::{Vec2, Vec3};

use super::random::{floor_i32, unit2};

/// Value noise of wavelength 1 in `[-1, 1]`, with continuous second derivatives.
#[inline]
pub(super) fn noise2(p: Vec2, seed: u32) -> f32 {
    let (x, y) = (floor_i32(p.x), floor_i32(p.y));
    let (fx, fy) = (fade(p.x - x as f32), fade(p.y - y as f32));
    let low = mix(unit2(x, y, seed), unit2(x + 1, y, seed), fx);
    let high = mix(unit2(x, y + 1, seed), unit2(x + 1, y + 1, seed), fx);
    2.0 * mix(low, high, fy) - 1.0
}

/// Cheap noise in space: the scaled sum of plane noise on two slanted projections.
#[inline]
pub(super) fn noise3(p: Vec3, seed: u32) -> f32 {
    let a = noise2(Vec2::new(p.x + 0.37 * p.z, p.y - 0.61 * p.z), seed);
    let b = noise2(Vec2::new(p.z + 0.29 * p.y, p.x + 0.53 * p.y), seed ^ 0x51ed_270b);
    0.7 * (a + b)
}

/// Noise of one wavelength, faded out where samples `footprint_m` apart would alias it.
#[inline]
pub(super) fn grain(p: Vec2, wavelength_m: f32, footprint_m: f32, seed: u32) -> f32 {
    let weight = visible(wavelength_m, footprint_m);
    if weight <= 0.0 { 0.0 } else { weight * noise2(p * (1.0 / wavelength_m), seed) }
}

/// A sum of `octaves` grains, each with half the wavelength and 0.6 times the strength of the previous
/// one; in about `[-1, 1]`.
#[inline]
pub(super) fn fractal(p: Vec2, longest_m: f32, octaves: u32, footprint_m: f32, seed: u32) -> f32 {
    let (mut sum, mut strength, mut wavelength_m, mut p) = (0.0, 0.55, longest_m, p);
    for octave in 0..octaves {
        if visible(wavelength_m, footprint_m) <= 0.0 {
            break;
        }
        sum += strength * grain(p, wavelength_m, footprint_m, seed.wrapping_add(octave));
        // Rotated by an angle of the 3-4-5 triangle, so that the lattices of the octaves do not align.
        p = Vec2::new(0.8 * p.x - 0.6 * p.y, 0.6 * p.x + 0.8 * p.y);
        strength *= 0.6;
        wavelength_m *= 0.5;
    }
    sum
}

/// How visible a pattern of this wavelength is at this sample distance, 0 to 1.
#[inline]
pub(super) fn visible(wavelength_m: f32, footprint_m: f32) -> f32 {
    (wavelength_m / footprint_m - 1.0).clamp(0.0, 1.0)
}

/// 0 below `low`, 1 above `high`, smooth in between.
#[inline]
pub(super) fn step(low: f32, high: f32, x: f32) -> f32 {
    let t = ((x - low) / (high - low)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// Linear interpolation from `a` at 0 to `b` at 1.
#[inline]
pub(super) fn mix(a: f32, b: f32, t: f32) -> f32 {
    a + (b - a) * t
}

#[inline]
fn fade(t: f32) -> f32 {
    t * t * t * (t * (t * 6.0 - 15.0) + 10.0)
}
