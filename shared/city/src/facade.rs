//! Textures of walls with windows, doors and shop fronts.

use glam::{Vec2, Vec3};

use super::appearance::{Appearance, Spot};
use super::noise::{fractal, grain, mix, step, visible};
use super::random::{Rng, floor_i32, fraction, unit2};

/// The construction of a wall.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Wall {
    Brick,
    Plaster,
    /// Plaster between visible beams.
    Timbered,
    /// Precast concrete panels, one per bay and floor.
    Panels,
    /// Glass from floor to floor between mullions.
    Curtain,
    /// Upright boards or corrugated sheet, few windows.
    Boards,
    /// Rough stone blocks, tall windows.
    Stone,
}

/// The texture of a building's walls. The texture position is (bays, floors) from a corner at floor level.
#[derive(Clone, Debug)]
pub(super) struct Facade {
    pub(super) wall: Wall,
    /// Mean colour of the wall.
    pub(super) albedo: Vec3,
    /// Colour of frames, sills and bands.
    pub(super) trim: Vec3,
    /// Colour of doors, shutters and signs.
    pub(super) accent: Vec3,
    /// Width of a bay.
    pub(super) bay_m: f32,
    /// Height of a floor.
    pub(super) floor_m: f32,
    /// Fraction of bays with windows, 0 to 1.
    pub(super) windows: f32,
    /// Whether the ground floor has shops.
    pub(super) shops: bool,
    pub(super) shutters: bool,
    pub(super) seed: u32,
}

/// The position of a spot in its bay.
struct Bay {
    /// Offset from the bay's lower left corner, metres.
    at_m: Vec2,
    column: i32,
    floor: i32,
}

const PLASTERS: [Vec3; 9] = [
    Vec3::new(0.66, 0.60, 0.48),
    Vec3::new(0.62, 0.47, 0.27),
    Vec3::new(0.58, 0.34, 0.24),
    Vec3::new(0.70, 0.67, 0.60),
    Vec3::new(0.47, 0.52, 0.42),
    Vec3::new(0.40, 0.47, 0.54),
    Vec3::new(0.63, 0.52, 0.40),
    Vec3::new(0.55, 0.44, 0.42),
    Vec3::new(0.36, 0.34, 0.31),
];
const BRICKS: [Vec3; 5] = [
    Vec3::new(0.30, 0.12, 0.075),
    Vec3::new(0.36, 0.19, 0.11),
    Vec3::new(0.24, 0.10, 0.085),
    Vec3::new(0.45, 0.33, 0.20),
    Vec3::new(0.20, 0.13, 0.11),
];
const ACCENTS: [Vec3; 8] = [
    Vec3::new(0.10, 0.18, 0.12),
    Vec3::new(0.28, 0.06, 0.05),
    Vec3::new(0.06, 0.11, 0.24),
    Vec3::new(0.22, 0.13, 0.06),
    Vec3::new(0.50, 0.40, 0.10),
    Vec3::new(0.08, 0.22, 0.24),
    Vec3::new(0.40, 0.40, 0.38),
    Vec3::new(0.30, 0.12, 0.22),
];

impl Facade {
    /// A facade with walls of this kind, in random colours and dimensions.
    pub(super) fn random(wall: Wall, rng: &mut Rng) -> Self {
        let albedo = match wall {
            Wall::Brick => rng.pick(&BRICKS),
            Wall::Plaster => rng.pick(&PLASTERS),
            Wall::Timbered => Vec3::new(0.68, 0.63, 0.53),
            Wall::Panels => Vec3::splat(rng.range(0.32, 0.5)) * Vec3::new(1.0, 0.97, 0.9),
            Wall::Curtain => Vec3::new(0.20, 0.22, 0.24),
            Wall::Boards => rng.pick(&[
                Vec3::new(0.24, 0.12, 0.07),
                Vec3::new(0.30, 0.31, 0.32),
                Vec3::new(0.16, 0.24, 0.28),
                Vec3::new(0.42, 0.38, 0.28),
            ]),
            Wall::Stone => Vec3::new(0.40, 0.36, 0.29),
        };
        let (bay_m, floor_m, windows) = match wall {
            Wall::Curtain => (rng.range(1.5, 2.2), 3.6, 1.0),
            Wall::Panels => (rng.range(3.0, 3.8), 2.9, 0.95),
            Wall::Boards => (rng.range(4.0, 6.0), 3.4, 0.3),
            Wall::Stone => (4.4, 7.0, 0.9),
            _ => (rng.range(2.3, 3.3), rng.range(2.9, 3.4), rng.range(0.8, 1.0)),
        };
        Self {
            wall,
            albedo: albedo * rng.range(0.85, 1.1),
            trim: Vec3::splat(rng.pick(&[0.62, 0.55, 0.40, 0.16])),
            accent: rng.pick(&ACCENTS),
            bay_m,
            floor_m,
            windows,
            shops: false,
            shutters: wall == Wall::Plaster && rng.chance(0.4),
            seed: rng.seed(),
        }
    }

    /// The wall's appearance at a spot.
    pub(super) fn appearance(&self, spot: &Spot) -> Appearance {
        let (column, floor) = (floor_i32(spot.uv.x), floor_i32(spot.uv.y));
        let at_m = Vec2::new(fraction(spot.uv.x) * self.bay_m, fraction(spot.uv.y) * self.floor_m);
        let bay = Bay { at_m, column, floor };
        let wall_m = spot.uv * Vec2::new(self.bay_m, self.floor_m);
        let opening = match floor {
            ..0 => None,
            0 if self.shops => self.shop(&bay),
            0 => self.door(&bay).or_else(|| self.window(&bay)),
            _ => self.window(&bay),
        };
        opening.unwrap_or_else(|| Appearance::matt(self.masonry(&bay, wall_m, spot.footprint_m)))
    }

    fn chance(&self, bay: &Bay, salt: u32) -> f32 {
        unit2(bay.column, bay.floor, self.seed ^ salt.wrapping_mul(0x9e37_79b9))
    }

    /// Half width, sill height and lintel height of the windows, metres.
    fn window_measures(&self) -> (f32, f32, f32) {
        let (bay, floor) = (self.bay_m, self.floor_m);
        match self.wall {
            Wall::Curtain => (0.5 * bay - 0.06, 0.55, floor - 0.1),
            Wall::Panels => (0.34 * bay, 0.30 * floor, 0.80 * floor),
            Wall::Boards => (0.30 * bay, 0.55 * floor, 0.80 * floor),
            Wall::Stone => (0.16 * bay, 0.25 * floor, 0.85 * floor),
            _ => (0.21 * bay, 0.29 * floor, 0.80 * floor),
        }
    }

    fn window(&self, bay: &Bay) -> Option<Appearance> {
        if self.chance(bay, 1) > self.windows {
            return None;
        }
        let (half, sill, lintel) = self.window_measures();
        let x = bay.at_m.x - 0.5 * self.bay_m;
        let y = bay.at_m.y;
        let frame_m = if self.wall == Wall::Curtain { 0.0 } else { 0.09 };
        if x.abs() < half && y > sill && y < lintel {
            let border = (half - x.abs()).min(lintel - y).min(y - sill) < frame_m;
            let bars = self.wall != Wall::Curtain && self.wall != Wall::Panels;
            if border || (bars && x.abs() < 0.045) {
                return Some(Appearance::matt(self.trim));
            }
            return Some(self.pane(bay, (lintel - y) / (lintel - sill), y));
        }
        let sill_band = self.wall != Wall::Curtain && x.abs() < half + 0.12 && y <= sill && y > sill - 0.14;
        if sill_band {
            return Some(Appearance::matt(self.trim * 0.9));
        }
        let beside = self.shutters && x.abs() < 1.75 * half && y > sill && y < lintel;
        if beside {
            let slat = 0.8 + 0.4 * fraction(y / 0.22);
            return Some(Appearance::matt(self.accent * slat));
        }
        None
    }

    /// Glass with dark rooms, blinds and curtains behind it. `depth` runs from 0 at the lintel to 1 at the sill.
    fn pane(&self, bay: &Bay, depth: f32, y: f32) -> Appearance {
        let room = 0.02 + 0.05 * self.chance(bay, 2);
        let mut albedo = Vec3::new(0.8, 0.95, 1.1) * room;
        let blind = 1.3 * self.chance(bay, 3) - 0.3;
        if self.wall == Wall::Curtain {
            albedo = albedo * 0.7 + Vec3::new(0.01, 0.025, 0.04);
        }
        if depth < blind {
            let slats = 0.85 + 0.3 * fraction(y / 0.18);
            albedo = Vec3::new(0.40, 0.37, 0.32) * (slats * (0.4 + 0.6 * self.chance(bay, 4)));
        }
        // The lintel's shadow on the recessed pane.
        albedo *= mix(0.35, 1.0, step(0.0, 0.14, depth));
        Appearance::glossy(albedo, if self.wall == Wall::Curtain { 0.16 } else { 0.09 })
    }

    fn door(&self, bay: &Bay) -> Option<Appearance> {
        let every = if self.wall == Wall::Boards { 0.5 } else { 0.17 };
        if self.chance(bay, 5) > every {
            return None;
        }
        let half = if self.wall == Wall::Boards { 0.32 * self.bay_m } else { 0.6 };
        let x = bay.at_m.x - 0.5 * self.bay_m;
        let y = bay.at_m.y;
        let height = 0.78 * self.floor_m;
        if x.abs() > half + 0.12 || y > height {
            return None;
        }
        if x.abs() > half || y > height - 0.12 {
            return Some(Appearance::matt(self.trim));
        }
        let panel = if fraction(y / 0.55) < 0.12 { 0.6 } else { 1.0 };
        Some(Appearance::matt(self.accent * panel))
    }

    fn shop(&self, bay: &Bay) -> Option<Appearance> {
        let (x, y) = (bay.at_m.x / self.bay_m, bay.at_m.y / self.floor_m);
        let unit = bay.column.div_euclid(2);
        if (0.76..0.94).contains(&y) {
            let tone = unit2(unit, 1, self.seed);
            let sign = ACCENTS[(tone * 7.99) as usize];
            let letters = fraction(bay.at_m.x / 0.45) < 0.6 && (0.81..0.89).contains(&y) && tone > 0.3;
            return Some(Appearance::matt(if letters { Vec3::splat(0.6) } else { sign }));
        }
        if (0.06..0.94).contains(&x) && (0.1..0.72).contains(&y) {
            let goods =
                self.chance(&Bay { at_m: bay.at_m, column: floor_i32(bay.at_m.x * 2.5), floor: unit }, 6);
            return Some(Appearance::glossy(Vec3::new(0.06, 0.05, 0.04) * (0.3 + 2.0 * goods), 0.09));
        }
        None
    }

    fn masonry(&self, bay: &Bay, wall_m: Vec2, f: f32) -> Vec3 {
        let streaks = grain(Vec2::new(wall_m.x, wall_m.y * 0.12), 0.55, f, self.seed ^ 3);
        let stains = fractal(wall_m, 3.7, 5, f, self.seed);
        let dirt = 0.35 * (1.0 - step(0.0, 0.9, wall_m.y)) + 0.10 * streaks.max(0.0);
        let weather = (1.0 + 0.16 * stains) * (1.0 - dirt);
        let band = bay.at_m.y < 0.16 && bay.floor > 0;
        let texture = match self.wall {
            Wall::Brick => {
                if band && bay.floor & 1 == 1 {
                    return self.trim * (0.8 * weather);
                }
                bricks(wall_m, Vec2::new(0.26, 0.085), f, self.seed)
            }
            Wall::Stone => bricks(wall_m, Vec2::new(0.9, 0.42), f, self.seed),
            Wall::Plaster if band => return self.trim * weather,
            Wall::Timbered => return self.timbered(bay, wall_m, f) * weather,
            Wall::Panels => {
                let edge = bay.at_m.x.min(self.bay_m - bay.at_m.x).min(bay.at_m.y);
                let tone = 0.9 + 0.2 * self.chance(bay, 8);
                tone * if edge < 0.05 { 0.45 } else { 1.0 }
            }
            Wall::Curtain => {
                if bay.at_m.y < 0.55 {
                    0.6
                } else {
                    1.0
                }
            }
            Wall::Boards => {
                let board = wall_m.x / 0.3;
                let gap = if fraction(board) < 0.14 { 0.45 * visible(0.3, f) } else { 0.0 };
                (0.85 + 0.3 * unit2(floor_i32(board), 0, self.seed) * visible(0.3, f)) * (1.0 - gap)
            }
            Wall::Plaster => 1.0 + 0.1 * grain(wall_m, 0.11, f, self.seed ^ 5),
        };
        self.albedo * (texture * weather)
    }

    fn timbered(&self, bay: &Bay, wall_m: Vec2, f: f32) -> Vec3 {
        let beam = Vec3::new(0.09, 0.055, 0.035);
        let (x, y) = (bay.at_m.x, bay.at_m.y);
        let post = x < 0.11 || x > self.bay_m - 0.11 || y < 0.2 || (y - 0.27 * self.floor_m).abs() < 0.08;
        let slope = (x / self.bay_m - y / self.floor_m).abs() * self.bay_m;
        let brace = self.chance(bay, 9) < 0.35 && slope < 0.12;
        let infill = self.albedo * (1.0 + 0.12 * grain(wall_m, 0.2, f, self.seed));
        if bay.floor > 0 && (post || brace) { beam } else { infill }
    }
}

/// Brightness of masonry with stones of `size_m`, each in its own tone, and mortar joints.
pub(super) fn bricks(p: Vec2, size_m: Vec2, f: f32, seed: u32) -> f32 {
    let row = floor_i32(p.y / size_m.y);
    let shifted = p.x / size_m.x + 0.5 * (row & 1) as f32;
    let seen = visible(size_m.y * 1.6, f);
    let tone = 0.45 * (unit2(floor_i32(shifted), row, seed) - 0.5);
    let (fx, fy) = (fraction(shifted) * size_m.x, fraction(p.y / size_m.y) * size_m.y);
    let joint = if fx < 0.1 * size_m.y.max(0.1) || fy < 0.14 * size_m.y { 0.35 } else { 0.0 };
    // Bricks fired together share a tone, which stays visible where single bricks are too small.
    let lot = 0.16 * (unit2(floor_i32(p.x / (4.0 * size_m.x)), row.div_euclid(5), seed ^ 11) - 0.5);
    1.0 + (tone + joint) * seen + lot * visible(size_m.x * 3.0, f)
}
