//! Putting the town together: plan, terrain, ground, blocks, streets, light.

use glam::{Vec2, Vec3};

use super::bvh::Bvh;
use super::light::Light;
use super::mesh::Mesh;
use super::palette::Palette;
use super::paving::{Land, Patch};
use super::plan::{Block, BlockKind, KERB_HEIGHT_M, Plan};
use super::random::Rng;
use super::render::World;
use super::site::Site;
use super::terrain::Terrain;
use super::{centre, country, ground, roadside, suburb};

/// How far the water of a pond stands below its banks, metres.
const BANK_M: f32 = 0.4;

/// A pond: centre in the plan, radius, height of the water, metres.
type Pond = (Vec2, f32, f32);

impl World {
    /// Builds the town around a flown square of half side `flown_half_m`, with land up to `reach_m`.
    pub(super) fn build(seed: u64, flown_half_m: f32, reach_m: f32) -> Self {
        let mut rng = Rng::new(seed, 4);
        let plan = Plan::new(seed, flown_half_m, reach_m);
        let mut terrain = Terrain::new(rng.seed());
        let ponds: Vec<Option<Pond>> = plan.blocks.iter().map(|b| dig_pond(b, &plan, &mut terrain)).collect();
        let mut mesh = Mesh::default();
        let palette = Palette::new(&mut mesh, &mut rng);
        ground::build(&mut mesh, &plan, &terrain, flown_half_m);
        let patches = plan
            .blocks
            .iter()
            .zip(ponds)
            .map(|(block, pond)| build_block(Site::new(&mut mesh, &plan, &terrain, &palette, *block), pond))
            .collect();
        roadside::furnish(&mut mesh, &plan, &terrain, &palette, &mut rng);
        let sun = Vec3::new(rng.range(0.35, 0.65), rng.range(-0.75, -0.45), rng.range(0.85, 1.05));
        let corners: Vec<[Vec3; 3]> = mesh.triangles.iter().map(|t| t.corners).collect();
        let bvh = Bvh::build(&corners);
        let light = Light::new(&bvh, &mesh.triangles, reach_m, sun);
        Self { land: Land { patches }, plan, mesh, bvh, light }
    }
}

fn dig_pond(block: &Block, plan: &Plan, terrain: &mut Terrain) -> Option<Pond> {
    let size = block.max - block.min;
    let radius_m = 0.17 * size.min_element();
    (block.kind == BlockKind::Park && radius_m > 3.0).then(|| {
        let uv = block.min + size * Vec2::new(0.55, 0.5);
        let level = terrain.level(plan.to_world(uv), radius_m, 1.1);
        (uv, radius_m, level + KERB_HEIGHT_M - BANK_M)
    })
}

fn build_block(mut site: Site, pond: Option<Pond>) -> Vec<Patch> {
    match site.block.kind {
        BlockKind::Perimeter => centre::perimeter(&mut site),
        BlockKind::Plaza => centre::plaza(&mut site),
        BlockKind::Towers => centre::towers(&mut site),
        BlockKind::Slabs => centre::slabs(&mut site),
        BlockKind::Villas => suburb::villas(&mut site),
        BlockKind::Park => suburb::park(&mut site, pond),
        BlockKind::School => suburb::school(&mut site),
        BlockKind::Hall => suburb::hall(&mut site),
        BlockKind::Field => country::field(&mut site),
        BlockKind::Meadow => country::meadow(&mut site),
        BlockKind::Forest => country::forest(&mut site),
        BlockKind::Orchard => country::orchard(&mut site),
        BlockKind::Farm => country::farm(&mut site),
    }
    site.patches
}
