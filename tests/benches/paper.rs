//! Compares this project's settings with those of the paper (CoSurfGS), each choice on its own and all together.
//!
//! `cargo bench -p cosurf-tests --bench paper -- --help`

mod ablation;
mod surface;

use ablation::{Variant, compare};
use anyhow::Result;
use cosurf_engine::{PruneSettings, SurfaceSettings};

fn main() -> Result<()> {
    let (ours, paper) = (SurfaceSettings::default(), SurfaceSettings::paper());
    let (prune, papers_prune) = (PruneSettings::default(), PruneSettings::paper());
    let variant = |name: &str, surface: SurfaceSettings, prune: PruneSettings| Variant {
        name: name.into(),
        surface: Some(surface),
        prune: Some(prune),
    };
    let surface = |name: &str, surface: SurfaceSettings| variant(name, surface, prune);
    compare(
        "paper",
        &[
            surface("ours", ours),
            surface("scales 25 (ours 100)", SurfaceSettings { scale: paper.scale, ..ours }),
            surface("normals 0.01 (0.04)", SurfaceSettings { normal: paper.normal, ..ours }),
            surface("patches 0.2 (1)", SurfaceSettings { ncc: paper.ncc, ..ours }),
            surface("patches of 7 × 7 px (3 × 3)", SurfaceSettings { patch: paper.patch, ..ours }),
            surface("all pixels compared (a quarter)", SurfaceSettings { cell_px: paper.cell_px, ..ours }),
            variant("20 % pruned (40 %)", ours, PruneSettings { ratio: papers_prune.ratio, ..prune }),
            variant("pruned by its score", ours, PruneSettings { score: papers_prune.score, ..prune }),
            variant("all of the paper's", paper, papers_prune),
        ],
    )
}
