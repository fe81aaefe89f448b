//! Textures of roofs: tiles, slate and sheet metal, and the covers of flat roofs.

use glam::{Vec2, Vec3};

use super::appearance::{Appearance, Spot};
use super::noise::{fractal, grain, mix, step, visible};
use super::random::{Rng, floor_i32, fraction, unit2};

/// The covering of a roof.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Cover {
    /// Clay tiles in courses.
    Tiles,
    Slate,
    /// Metal sheets with standing seams down the slope.
    Sheet,
    /// Gravel on a flat roof.
    Gravel,
    /// Welded strips of felt on a flat roof.
    Felt,
    /// Stonecrop on a flat roof.
    Sedum,
}

/// The texture of a roof. The texture position is in metres along the eaves and up the slope.
#[derive(Clone, Debug)]
pub(super) struct Roofing {
    pub(super) cover: Cover,
    pub(super) albedo: Vec3,
    /// Fraction of the 2.5 by 3 m fields with a roof window, 0 to 1.
    pub(super) windows: f32,
    pub(super) seed: u32,
}

const TILES: [Vec3; 6] = [
    Vec3::new(0.34, 0.125, 0.065),
    Vec3::new(0.27, 0.095, 0.060),
    Vec3::new(0.38, 0.18, 0.10),
    Vec3::new(0.19, 0.085, 0.065),
    Vec3::new(0.13, 0.10, 0.09),
    Vec3::new(0.30, 0.15, 0.09),
];
const SHEETS: [Vec3; 5] = [
    Vec3::new(0.40, 0.42, 0.43),
    Vec3::new(0.22, 0.34, 0.28),
    Vec3::new(0.30, 0.12, 0.09),
    Vec3::new(0.55, 0.54, 0.50),
    Vec3::new(0.14, 0.16, 0.19),
];

impl Roofing {
    /// A roof with this cover in random colours.
    pub(super) fn random(cover: Cover, rng: &mut Rng) -> Self {
        let albedo = match cover {
            Cover::Tiles => rng.pick(&TILES),
            Cover::Slate => Vec3::new(0.115, 0.125, 0.145),
            Cover::Sheet => rng.pick(&SHEETS),
            Cover::Gravel => rng.pick(&[Vec3::new(0.34, 0.32, 0.28), Vec3::new(0.22, 0.21, 0.20)]),
            Cover::Felt => rng.pick(&[
                Vec3::new(0.11, 0.11, 0.12),
                Vec3::new(0.45, 0.45, 0.43),
                Vec3::new(0.20, 0.22, 0.20),
            ]),
            Cover::Sedum => Vec3::new(0.13, 0.14, 0.055),
        };
        let windows = if cover == Cover::Tiles && rng.chance(0.5) { rng.range(0.1, 0.3) } else { 0.0 };
        Self { cover, albedo: albedo * rng.range(0.85, 1.15), windows, seed: rng.seed() }
    }

    /// The roof's appearance at a spot.
    pub(super) fn appearance(&self, spot: &Spot) -> Appearance {
        let (p, f) = (spot.uv, spot.footprint_m);
        if let Some(window) = self.window(p) {
            return window;
        }
        let weather = fractal(p, 4.3, 5, f, self.seed ^ 21);
        match self.cover {
            Cover::Tiles => Appearance::matt(self.tiles(p, f, weather, Vec2::new(0.30, 0.38))),
            Cover::Slate => Appearance::glossy(self.tiles(p, f, weather, Vec2::new(0.34, 0.26)), 0.03),
            Cover::Sheet => self.sheet(p, f, weather),
            Cover::Gravel => {
                let stones = grain(p, 0.45, f, self.seed) + grain(p * 2.9, 0.45, f * 2.9, self.seed ^ 1);
                Appearance::matt(self.albedo * (1.0 + 0.20 * stones + 0.22 * weather))
            }
            Cover::Felt => self.felt(p, f, weather),
            Cover::Sedum => {
                let red = step(-0.1, 0.5, fractal(p, 2.2, 4, f, self.seed ^ 4));
                let tint = Vec3::new(mix(0.8, 1.7, red), mix(1.15, 0.8, red), 1.0);
                Appearance::matt(self.albedo * tint * (1.0 + 0.5 * weather))
            }
        }
    }

    fn window(&self, p: Vec2) -> Option<Appearance> {
        if self.windows <= 0.0 {
            return None;
        }
        let (x, y) = (p.x / 2.5, (p.y - 0.6) / 3.0);
        if unit2(floor_i32(x), floor_i32(y), self.seed ^ 99) > self.windows {
            return None;
        }
        let at = Vec2::new((fraction(x) - 0.5) * 2.5, (fraction(y) - 0.5) * 3.0).abs();
        if at.x > 0.52 || at.y > 0.75 {
            return None;
        }
        let frame = at.x > 0.42 || at.y > 0.65;
        Some(if frame {
            Appearance::matt(Vec3::splat(0.13))
        } else {
            Appearance::glossy(Vec3::new(0.03, 0.04, 0.05), 0.12)
        })
    }

    fn tiles(&self, p: Vec2, f: f32, weather: f32, size_m: Vec2) -> Vec3 {
        let course = p.y / size_m.y;
        let row = floor_i32(course);
        let across = p.x / size_m.x + 0.5 * (row & 1) as f32;
        let tile = unit2(floor_i32(across), row, self.seed);
        let seen = visible(size_m.x * 1.5, f);
        let rounded = (fraction(across) - 0.5).abs();
        let step_down = 0.30 * (1.0 - step(0.0, 0.25, fraction(course))) + 0.35 * (rounded - 0.25);
        // Tiles of one pallet share a tone, which is visible from farther away.
        let lot = unit2(floor_i32(p.x / 1.7), row.div_euclid(3), self.seed ^ 5) - 0.5;
        let tone = 1.0 + seen * (0.5 * (tile - 0.5) - step_down) + 0.22 * lot + 0.30 * weather;
        let runs = grain(Vec2::new(p.x, 0.15 * p.y), 0.4, f, self.seed ^ 31);
        let moss = step(0.15, 0.6, weather + 0.35 * runs) * 0.55;
        let clay = self.albedo * tone;
        clay + (Vec3::new(0.085, 0.10, 0.05) - clay) * moss
    }

    fn sheet(&self, p: Vec2, f: f32, weather: f32) -> Appearance {
        let at = fraction(p.x / 0.6);
        let seam = if at < 0.12 {
            -0.35
        } else if at < 0.22 {
            0.2
        } else {
            0.0
        };
        let sheet = unit2(floor_i32(p.x / 0.6), floor_i32(p.y / 6.0), self.seed) - 0.5;
        let lap = if fraction(p.y / 6.0) < 0.015 { -0.3 } else { 0.0 };
        let tone = 1.0 + (seam + 0.14 * sheet) * visible(0.6, f) + lap + 0.15 * weather;
        let rust = step(0.25, 0.7, weather + 0.3 * grain(Vec2::new(p.x, 0.1 * p.y), 0.5, f, self.seed));
        let albedo = self.albedo * tone;
        Appearance::glossy(
            albedo + (Vec3::new(0.22, 0.10, 0.05) - albedo) * (0.6 * rust),
            0.05 * (1.0 - rust),
        )
    }

    fn felt(&self, p: Vec2, f: f32, weather: f32) -> Appearance {
        let strip = p.x / 1.05;
        let tone = 0.30 * (unit2(floor_i32(strip), floor_i32(p.y / 7.3), self.seed) - 0.5);
        let seam = if fraction(strip) < 0.07 || fraction(p.y / 7.3) < 0.012 { 0.35 } else { 0.0 };
        let patch_cell = (floor_i32(p.x / 3.1), floor_i32(p.y / 2.3));
        let patched = unit2(patch_cell.0, patch_cell.1, self.seed ^ 8) < 0.08;
        let patch = if patched && fraction(p.x / 3.1) < 0.5 && fraction(p.y / 2.3) < 0.6 { 0.4 } else { 0.0 };
        let puddle = step(0.28, 0.4, fractal(p, 6.0, 3, f, self.seed ^ 17));
        let tone = 1.0 + tone + patch - seam * visible(0.5, f) + 0.2 * weather - 0.35 * puddle;
        Appearance::glossy(self.albedo * tone.max(0.2), 0.03 * puddle)
    }
}
