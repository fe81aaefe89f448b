//! Builds on the blocks: one file per group of block kinds.

mod common;
mod country;
mod park;
mod rows;
mod site;
mod square;
mod towers;
mod villas;
mod works;

use super::mesh::Mesh;
use super::palette::Palette;
use super::paving::Patch;
use super::plan::{Block, BlockKind, Plan};
use super::terrain::Terrain;
pub(super) use park::Pond;
use site::Site;

/// Digs the ponds of the parks. Returns the pond of each block, if it has one.
pub(super) fn dig_ponds(plan: &Plan, terrain: &mut Terrain) -> Vec<Option<Pond>> {
    plan.blocks.iter().map(|block| Pond::dig(block, plan, terrain)).collect()
}

/// Builds on all blocks; returns the ground patches of each.
pub(super) fn build(
    mesh: &mut Mesh,
    plan: &Plan,
    terrain: &Terrain,
    palette: &Palette,
    ponds: &[Option<Pond>],
) -> Vec<Vec<Patch>> {
    let build = |(block, pond): (&Block, &Option<Pond>)| {
        let mut site = Site::new(mesh, plan, terrain, palette, *block);
        build_one(&mut site, pond.as_ref());
        site.patches
    };
    plan.blocks.iter().zip(ponds).map(build).collect()
}

fn build_one(site: &mut Site, pond: Option<&Pond>) {
    match site.block.kind {
        BlockKind::Perimeter => rows::perimeter(site),
        BlockKind::Plaza => square::plaza(site),
        BlockKind::Towers => towers::towers(site),
        BlockKind::Slabs => towers::slabs(site),
        BlockKind::Villas => villas::villas(site),
        BlockKind::Park => park::park(site, pond),
        BlockKind::School => works::school(site),
        BlockKind::Hall => works::hall(site),
        BlockKind::Field => country::field(site),
        BlockKind::Meadow => country::meadow(site),
        BlockKind::Forest => country::forest(site),
        BlockKind::Orchard => country::orchard(site),
        BlockKind::Farm => country::farm(site),
    }
}
