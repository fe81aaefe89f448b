//! Textures of the ground of blocks: pavements, lawns, yards and fields, with patches on top.

use glam::{Vec2, Vec3};

use super::appearance::{Appearance, Spot};
use super::facade::bricks;
use super::noise::{fractal, grain, mix, noise2, step, visible};
use super::plan::{Block, BlockKind, Plan};
use super::random::{floor_i32, fraction, unit2};
use super::street::{asphalt, kerbstone};

/// The covering of the ground.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Surface {
    Lawn,
    /// Tall grass with flowers.
    Meadow,
    /// Concrete flags of this side, metres.
    Flags(f32),
    /// Setts with bands.
    Cobbles,
    Asphalt,
    Gravel,
    Sand,
    Soil,
    /// Asphalt with bays whose lines run along v (`false`) or u (`true`).
    CarPark(bool),
    /// Lawn mown in stripes with the lines of a pitch inside this rectangle.
    Pitch,
    /// Planks.
    Deck,
    /// A swimming pool.
    Pool,
    /// Crops: rows along v (`false`) or u (`true`), and the number of the crop.
    Crop(bool, u8),
    /// Leaf litter under trees.
    Litter,
    /// Red rubber of playgrounds and tracks.
    Rubber,
}

/// The outline of a patch, in plan metres.
#[derive(Clone, Copy, Debug)]
pub(super) enum Outline {
    /// Corners of least and greatest coordinates.
    Rectangle(Vec2, Vec2),
    /// Centre and radius, which varies by a tenth.
    Disc(Vec2, f32),
    /// Ends of the centre line, and width. The ends are round.
    Strip(Vec2, Vec2, f32),
    /// Centre, radius of the centre line, and width.
    Ring(Vec2, f32, f32),
}

/// A piece of ground with another covering than its block.
#[derive(Clone, Copy, Debug)]
pub(super) struct Patch {
    pub(super) outline: Outline,
    pub(super) surface: Surface,
}

/// The patches of every block; later patches lie on top.
#[derive(Clone, Debug, Default)]
pub(super) struct Land {
    pub(super) patches: Vec<Vec<Patch>>,
}

/// Width of the pavement along a town block's kerb, metres.
pub(super) const PAVEMENT_M: f32 = 2.4;

impl Outline {
    fn holds(&self, p: Vec2) -> bool {
        match *self {
            Self::Rectangle(min, max) => p.cmpge(min).all() && p.cmple(max).all(),
            Self::Disc(center, radius) => {
                let d = p.distance(center);
                d < 1.1 * radius && d < radius * (1.0 + 0.1 * noise2(p * 0.4, 3))
            }
            Self::Strip(a, b, width) => distance_to_segment(p, a, b) < 0.5 * width,
            Self::Ring(center, radius, width) => (p.distance(center) - radius).abs() < 0.5 * width,
        }
    }
}

fn distance_to_segment(p: Vec2, a: Vec2, b: Vec2) -> f32 {
    let along = b - a;
    let t = ((p - a).dot(along) / along.length_squared().max(1e-6)).clamp(0.0, 1.0);
    p.distance(a + along * t)
}

impl Land {
    /// The appearance of a block's ground at a spot whose texture position is the plan position.
    pub(super) fn appearance(&self, block: usize, spot: &Spot, plan: &Plan) -> Appearance {
        let p = spot.uv;
        let (land, seed) = (&plan.blocks[block], plan.blocks[block].seed);
        if land.kind.in_town() {
            let inside = (p - land.min).min(land.max - p).min_element();
            if inside < PAVEMENT_M {
                return Appearance::matt(pavement(p, inside, spot.footprint_m, seed));
            }
        }
        let patch = self.patches[block].iter().rev().find(|patch| patch.outline.holds(p));
        match patch {
            Some(patch) => surface(patch.surface, Some(&patch.outline), spot, seed),
            None => surface(ground_of(land), None, spot, seed),
        }
    }
}

/// The covering of a block outside its patches.
fn ground_of(block: &Block) -> Surface {
    match block.kind {
        BlockKind::Perimeter => Surface::Gravel,
        BlockKind::Plaza => Surface::Cobbles,
        BlockKind::Villas | BlockKind::Park | BlockKind::Slabs | BlockKind::School => Surface::Lawn,
        BlockKind::Towers => Surface::Flags(1.2),
        BlockKind::Hall => Surface::Asphalt,
        BlockKind::Field => Surface::Crop(block.seed & 1 == 0, (block.seed >> 1) as u8 % 4),
        BlockKind::Meadow | BlockKind::Orchard => Surface::Meadow,
        BlockKind::Forest => Surface::Litter,
        BlockKind::Farm => Surface::Soil,
    }
}

fn pavement(p: Vec2, from_kerb_m: f32, f: f32, seed: u32) -> Vec3 {
    if from_kerb_m < 0.22 {
        return kerbstone(p.x + p.y, f);
    }
    flags(p, 0.6, f, seed) * (1.0 + 0.12 * fractal(p, 3.0, 4, f, seed ^ 2))
}

fn flags(p: Vec2, size_m: f32, f: f32, seed: u32) -> Vec3 {
    let q = p * (1.0 / size_m);
    let (x, y) = (floor_i32(q.x), floor_i32(q.y));
    let tone = 0.26 * (unit2(x, y, seed) - 0.5) * visible(size_m * 1.6, f);
    let joint = if fraction(q.x).min(fraction(q.y)) < 0.06 { 0.3 * visible(size_m, f) } else { 0.0 };
    let group = 0.14 * (unit2(floor_i32(q.x * 0.25), floor_i32(q.y * 0.25), seed ^ 1) - 0.5);
    Vec3::new(0.275, 0.26, 0.235) * (1.0 + tone + group - joint)
}

/// A surface's appearance at a spot. `outline` is that of the patch, for markings relative to it.
fn surface(surface: Surface, outline: Option<&Outline>, spot: &Spot, seed: u32) -> Appearance {
    let (p, f) = (spot.uv, spot.footprint_m);
    let coarse = fractal(p, 6.5, 6, f, seed ^ 51);
    let matt = |albedo: Vec3| Appearance::matt(albedo);
    match surface {
        Surface::Lawn => matt(lawn(p, f, coarse, seed)),
        Surface::Meadow => matt(meadow(p, f, coarse, seed)),
        Surface::Flags(size_m) => matt(flags(p, size_m, f, seed) * (1.0 + 0.2 * coarse)),
        Surface::Cobbles => matt(cobbles(p, f, seed) * (1.0 + 0.22 * coarse)),
        Surface::Asphalt => matt(asphalt(p, f, seed)),
        Surface::Gravel => {
            let stones = 0.2 * grain(p, 0.22, f, seed) + 0.12 * grain(p, 0.7, f, seed ^ 1);
            matt(Vec3::new(0.33, 0.29, 0.23) * (1.0 + stones + 0.3 * coarse))
        }
        Surface::Sand => matt(Vec3::new(0.48, 0.39, 0.25) * (1.0 + 0.2 * coarse)),
        Surface::Soil => {
            let tracks = 0.25 * grain(Vec2::new(p.x, p.y * 0.2), 0.9, f, seed ^ 3);
            matt(Vec3::new(0.19, 0.135, 0.085) * (1.0 + tracks + 0.45 * coarse))
        }
        Surface::CarPark(turned) => matt(car_park(p, turned, outline, f, seed)),
        Surface::Pitch => matt(pitch(p, outline, f, coarse, seed)),
        Surface::Deck => {
            let plank = floor_i32(p.x / 0.28);
            let gap = if fraction(p.x / 0.28) < 0.1 { 0.4 * visible(0.28, f) } else { 0.0 };
            let tone = 0.85 + 0.3 * unit2(plank, floor_i32(p.y / 2.4), seed);
            matt(Vec3::new(0.25, 0.16, 0.095) * (tone * (1.0 - gap) + 0.15 * coarse))
        }
        Surface::Pool => {
            let caustics = 1.0 + 0.25 * fractal(p, 0.9, 3, f, seed ^ 2);
            let rim = outline.map_or(1.0, |o| border_distance(o, p));
            if rim < 0.45 {
                return matt(Vec3::new(0.52, 0.48, 0.40) * (1.0 + 0.2 * coarse));
            }
            Appearance::glossy(Vec3::new(0.045, 0.27, 0.33) * caustics, 0.04)
        }
        Surface::Crop(turned, kind) => matt(crop(p, turned, kind, f, coarse, seed)),
        Surface::Litter => {
            let spots = grain(p, 0.9, f, seed ^ 6);
            matt(Vec3::new(0.085, 0.075, 0.04) * (1.0 + 0.5 * coarse + 0.25 * spots))
        }
        Surface::Rubber => matt(Vec3::new(0.27, 0.085, 0.055) * (1.0 + 0.2 * coarse)),
    }
}

fn lawn(p: Vec2, f: f32, coarse: f32, seed: u32) -> Vec3 {
    let blades = 0.22 * grain(p, 0.17, f, seed ^ 1) + 0.20 * grain(p, 0.6, f, seed ^ 2);
    let dry = step(0.05, 0.6, fractal(p, 17.0, 4, f, seed ^ 3));
    let bare = step(0.38, 0.62, coarse) * 0.6;
    let green = Vec3::new(mix(0.085, 0.17, dry), mix(0.135, 0.16, dry), mix(0.035, 0.06, dry));
    let grass = green * (1.0 + blades + 0.42 * coarse);
    grass + (Vec3::new(0.20, 0.155, 0.095) - grass) * bare
}

fn meadow(p: Vec2, f: f32, coarse: f32, seed: u32) -> Vec3 {
    let tufts = 0.3 * grain(p, 1.1, f, seed ^ 1) + 0.25 * grain(p, 0.3, f, seed ^ 2);
    let flowers = visible(0.3, f) * step(0.62, 0.75, grain(p, 0.24, 0.01, seed ^ 4)) * step(0.0, 0.4, coarse);
    let hay = step(-0.2, 0.5, fractal(p, 23.0, 4, f, seed ^ 3));
    let green = Vec3::new(mix(0.10, 0.21, hay), mix(0.14, 0.19, hay), mix(0.04, 0.075, hay));
    let grass = green * (1.0 + tufts + 0.45 * coarse);
    grass + (Vec3::new(0.55, 0.50, 0.24) - grass) * (0.55 * flowers)
}

fn cobbles(p: Vec2, f: f32, seed: u32) -> Vec3 {
    let (gx, gy) = (fraction(p.x / 6.4) * 6.4, fraction(p.y / 6.4) * 6.4);
    let band = gx < 0.55 || gy < 0.55;
    let diamond = (gx - 3.4).abs() + (gy - 3.4).abs() < 1.35;
    let albedo = match (band, diamond) {
        (true, _) => Vec3::new(0.42, 0.39, 0.34),
        (_, true) => Vec3::new(0.30, 0.17, 0.13),
        _ => Vec3::new(0.235, 0.215, 0.20),
    };
    albedo * bricks(p, Vec2::new(0.22, 0.16), f, seed)
}

fn car_park(p: Vec2, turned: bool, outline: Option<&Outline>, f: f32, seed: u32) -> Vec3 {
    let ground = asphalt(p, f, seed);
    let Some(Outline::Rectangle(min, _)) = outline else { return ground };
    let q = if turned { Vec2::new(p.y - min.y, p.x - min.x) } else { p - *min };
    // A row of bays on each side of a 6 m lane; bays are 5 m deep and 2.5 m wide.
    let depth = fraction(q.y / 16.0) * 16.0;
    let bay = !(5.0..11.0).contains(&depth);
    let line = bay && fraction(q.x / 2.5) < 0.05;
    let wear = step(-0.6, 0.2, fractal(p, 1.0, 3, f, seed ^ 9) + 0.3);
    if line { ground + (Vec3::splat(0.55) - ground) * (0.85 * wear) } else { ground }
}

fn pitch(p: Vec2, outline: Option<&Outline>, f: f32, coarse: f32, seed: u32) -> Vec3 {
    let mown = if fraction(p.x / 5.0) < 0.5 { 1.14 } else { 0.88 };
    let grass =
        Vec3::new(0.075, 0.15, 0.035) * (mown * (1.0 + 0.28 * coarse + 0.15 * grain(p, 0.2, f, seed)));
    let Some(Outline::Rectangle(min, max)) = outline else { return grass };
    let (half, q) = ((*max - *min) * 0.5, p - (*min + *max) * 0.5);
    let line = |d: f32| d.abs() < 0.07;
    let from_border = (half - q.abs()).min_element() - 0.8;
    let on_x = half.x > half.y;
    let (long, short) = if on_x { (q.x, q.y) } else { (q.y, q.x) };
    let reach = half.max_element() - 0.8;
    let area = (reach - long.abs() - 0.22 * reach, short.abs() - 0.55 * (half.min_element() - 0.8));
    let box_line = (line(area.0) && area.1 < 0.0) || (line(area.1) && area.0 < 0.0);
    let circle = line(q.length() - 0.3 * half.min_element());
    let marked = from_border > -0.07 && (line(from_border) || line(long) || circle || box_line);
    let bare = step(0.3, 0.7, coarse - 1.5 * (area.0.abs() / reach) + 0.5) * 0.4;
    let ground = grass + (Vec3::new(0.2, 0.15, 0.09) - grass) * bare;
    if marked { ground + (Vec3::splat(0.6) - ground) * 0.85 } else { ground }
}

fn crop(p: Vec2, turned: bool, kind: u8, f: f32, coarse: f32, seed: u32) -> Vec3 {
    let q = if turned { Vec2::new(p.y, p.x) } else { p };
    let wander = 0.12 * grain(q, 9.0, f, seed ^ 3);
    let (row_m, plant, soil) = match kind {
        0 => (0.75, Vec3::new(0.10, 0.17, 0.04), Vec3::new(0.21, 0.155, 0.10)),
        1 => (0.5, Vec3::new(0.42, 0.33, 0.14), Vec3::new(0.33, 0.25, 0.12)),
        2 => (1.1, Vec3::new(0.20, 0.14, 0.085), Vec3::new(0.15, 0.10, 0.065)),
        _ => (1.6, Vec3::new(0.075, 0.13, 0.04), Vec3::new(0.25, 0.19, 0.12)),
    };
    let row = fraction((q.x + wander) / row_m);
    let plants = step(0.15, 0.35, row) - step(0.65, 0.85, row);
    let gaps = grain(q, 0.6, f, seed ^ 4);
    let seen = visible(row_m, f);
    let cover = mix(0.55, plants * (0.8 + 0.35 * gaps), seen).clamp(0.0, 1.0);
    let tramline = {
        let t = fraction(q.x / 14.0) * 14.0;
        if (t - 1.0).abs() < 0.22 || (t - 2.9).abs() < 0.22 { 0.75 } else { 0.0 }
    };
    let cover = cover * (1.0 - tramline);
    let leaves = 0.25 * grain(p, 0.21, f, seed ^ 5) + 0.15 * grain(p, 0.09, f, seed ^ 6);
    (soil + (plant - soil) * cover) * (1.0 + 0.4 * coarse + 0.12 * gaps + leaves)
}

fn border_distance(outline: &Outline, p: Vec2) -> f32 {
    match *outline {
        Outline::Rectangle(min, max) => (p - min).min(max - p).min_element(),
        Outline::Disc(center, radius) => radius - p.distance(center),
        Outline::Strip(a, b, width) => 0.5 * width - distance_to_segment(p, a, b),
        Outline::Ring(center, radius, width) => 0.5 * width - (p.distance(center) - radius).abs(),
    }
}
