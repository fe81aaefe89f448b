//! The terrain: gentle hills, levelled where a pond needs level ground.

use glam::Vec2;

use super::noise::{noise2, step};

/// A round area of level ground, with a bowl in it if `bowl_depth_m` is above 0.
#[derive(Clone, Copy, Debug)]
struct Level {
    center: Vec2,
    radius_m: f32,
    height_m: f32,
    bowl_depth_m: f32,
}

/// A height field over the whole plane.
#[derive(Clone, Debug)]
pub(super) struct Terrain {
    seed: u32,
    levels: Vec<Level>,
}

/// Wavelength and half height of the hills, metres. Their slopes stay below about 12 %.
const HILLS: [(f32, f32); 3] = [(190.0, 4.2), (83.0, 1.5), (31.0, 0.35)];

impl Terrain {
    pub(super) fn new(seed: u32) -> Self {
        Self { seed, levels: Vec::new() }
    }

    /// Height above the datum, metres.
    pub(super) fn height(&self, p: Vec2) -> f32 {
        let mut height = self.natural(p);
        for level in &self.levels {
            let distance = p.distance(level.center);
            if distance < 1.8 * level.radius_m {
                let inside = 1.0 - step(level.radius_m, 1.8 * level.radius_m, distance);
                height += (level.height_m - height) * inside;
                height -= level.bowl_depth_m * (1.0 - step(0.7 * level.radius_m, level.radius_m, distance));
            }
        }
        height
    }

    /// Levels the ground around `center` and digs a bowl into it (none if its depth is 0). Returns the
    /// height of the level ground.
    pub(super) fn level(&mut self, center: Vec2, radius_m: f32, bowl_depth_m: f32) -> f32 {
        let height_m = self.natural(center);
        self.levels.push(Level { center, radius_m, height_m, bowl_depth_m });
        height_m
    }

    fn natural(&self, p: Vec2) -> f32 {
        HILLS
            .iter()
            .zip(0u32..)
            .map(|(&(wavelength_m, half_height_m), i)| {
                half_height_m * noise2(p * (1.0 / wavelength_m), self.seed.wrapping_add(i))
            })
            .sum()
    }
}
