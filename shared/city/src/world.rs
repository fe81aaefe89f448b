//! Assembles the city from plan, terrain, ground, blocks, streets and light.

use glam::Vec3;

use super::light::Light;
use super::mesh::Mesh;
use super::palette::Palette;
use super::paving::Land;
use super::plan::Plan;
use super::random::Rng;
use super::render::World;
use super::terrain::Terrain;
use super::{blocks, ground, roadside};
use cosurf_scene::bvh::Bvh;

/// If pixels are smaller than this on the ground, trees get single sprays of leaves, metres.
const FINE_PIXEL_M: f32 = 0.45;

impl World {
    /// Builds the city around a flown square of half side `flown_half_m`, with land up to `reach_m`,
    /// for pictures whose pixels are `pixel_m` wide on the ground.
    pub(super) fn build(seed: u64, flown_half_m: f32, reach_m: f32, pixel_m: f32) -> Self {
        let mut rng = Rng::new(seed, 4);
        let plan = Plan::new(seed, flown_half_m, reach_m, pixel_m < FINE_PIXEL_M);
        let mut terrain = Terrain::new(rng.seed());
        let ponds = blocks::dig_ponds(&plan, &mut terrain);
        let mut mesh = Mesh::default();
        let palette = Palette::new(&mut mesh, &mut rng);
        ground::build(&mut mesh, &plan, &terrain, flown_half_m);
        let patches = blocks::build(&mut mesh, &plan, &terrain, &palette, &ponds);
        roadside::furnish(&mut mesh, &plan, &terrain, &palette, &mut rng);
        let sun = Vec3::new(rng.range(0.35, 0.65), rng.range(-0.75, -0.45), rng.range(0.85, 1.05));
        let corners: Vec<[Vec3; 3]> = mesh.triangles.iter().map(|t| t.corners).collect();
        let bvh = Bvh::build(&corners);
        let light = Light::new(&bvh, &mesh.triangles, reach_m, sun);
        Self { land: Land { patches }, plan, mesh, bvh, light }
    }
}
