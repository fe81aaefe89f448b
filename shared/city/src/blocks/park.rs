//! The park and its pond.

use glam::Vec2;

use super::site::Site;
use crate::paving::{Outline, Surface};
use crate::plan::{Block, BlockKind, KERB_HEIGHT_M, Plan};
use crate::props;
use crate::shapes::unit_circle;
use crate::terrain::Terrain;
use crate::tree::{self, Habit};

/// Depth of a pond's water level below its banks, metres.
const BANK_M: f32 = 0.4;
/// Depth of a pond's bowl, metres.
const BOWL_M: f32 = 1.1;

/// A pond in a park.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Pond {
    /// Plan position of its centre.
    uv: Vec2,
    radius_m: f32,
    /// Height of the water level.
    level_m: f32,
}

impl Pond {
    /// Digs a pond if the block is a park with enough room.
    pub(super) fn dig(block: &Block, plan: &Plan, terrain: &mut Terrain) -> Option<Self> {
        let size = block.max - block.min;
        let radius_m = 0.17 * size.min_element();
        (block.kind == BlockKind::Park && radius_m > 3.0).then(|| {
            let uv = block.min + size * Vec2::new(0.55, 0.5);
            let bank_m = terrain.level(plan.to_world(uv), radius_m, BOWL_M) + KERB_HEIGHT_M;
            Self { uv, radius_m, level_m: bank_m - BANK_M }
        })
    }
}

/// Builds a park: groves, winding paths, and the pond, whose bowl the terrain already has.
pub(super) fn park(site: &mut Site, pond: Option<&Pond>) {
    let size = site.size();
    let at = |x: f32, y: f32| site.block.min + size * Vec2::new(x, y);
    let stops = [
        at(0.06, 0.06),
        at(0.22, 0.18),
        at(0.30, 0.42),
        at(0.22, 0.66),
        at(0.40, 0.86),
        at(0.66, 0.88),
        at(0.85, 0.78),
        at(0.94, 0.94),
        at(0.85, 0.78),
        at(0.84, 0.46),
        at(0.76, 0.20),
        at(0.94, 0.06),
        at(0.76, 0.20),
        at(0.48, 0.14),
        at(0.22, 0.18),
    ];
    let paths: Vec<(Vec2, Vec2)> = stops.windows(2).map(|pair| (pair[0], pair[1])).collect();
    for (a, b) in paths {
        site.cover(Outline::Strip(a, b, 2.4), Surface::Gravel);
        for i in 0..4 {
            let uv = a + (b - a) * (i as f32 / 3.0);
            site.reserve((uv - 1.3, uv + 1.3));
        }
        let middle = (a + b) * 0.5 + (b - a).perp().normalize_or_zero() * 1.9;
        if site.rng.chance(0.6) {
            let frame = site.frame(middle, b - a);
            props::bench(site.mesh, &frame, site.palette);
        }
    }
    if let Some(&Pond { uv, radius_m, level_m }) = pond {
        site.cover(Outline::Disc(uv, 1.1 * radius_m), Surface::Gravel);
        site.reserve((uv - radius_m, uv + radius_m));
        let mut frame = site.frame(uv, Vec2::X);
        frame.origin.z = level_m;
        site.mesh.drum(&frame, [1.02 * radius_m; 2], [-0.02, 0.0], 28, [site.palette.water; 2]);
        for _ in 0..26 {
            let d = unit_circle(site.rng.unit()) * (radius_m * site.rng.range(1.0, 1.12));
            let height = site.rng.range(0.6, 1.5);
            let frame = site.frame(uv + d, Vec2::X);
            let detail = site.plan.detail(uv);
            tree::tree(site.mesh, &frame, Habit::Bush, height, detail, site.palette, &mut site.rng);
        }
    }
    let area = size.x * size.y;
    let habits = [Habit::Broad, Habit::Broad, Habit::Broad, Habit::Conifer, Habit::Poplar];
    site.scatter((area / 62.0) as usize, &habits, (5.0, 15.0));
    site.scatter((area / 130.0) as usize, &[Habit::Bush], (0.9, 2.2));
}
