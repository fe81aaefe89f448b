//! Measures the quality lost by pruning a share of the splats, for two formulas of their importance (CoSurfGS,
//! "Ablations of prune percentage").
//!
//! `cargo bench -p cosurf-tests --bench prune -- --help`

mod ablation;
mod surface;

use ablation::{Variant, compare};
use anyhow::Result;
use cosurf_engine::{PruneScore, PruneSettings, SurfaceSettings};

fn main() -> Result<()> {
    let variant = |name: String, prune: Option<PruneSettings>| Variant {
        name,
        surface: Some(SurfaceSettings::default()),
        prune,
    };
    let scores = [("", PruneScore::Corrected), (", the paper's score", PruneScore::Paper)];
    let pruned = scores.iter().flat_map(|&(name, score)| {
        [0.4, 0.6, 0.8].map(|ratio| {
            let prune = PruneSettings { ratio, score, ..PruneSettings::default() };
            variant(format!("{:.0} %{name}", 100.0 * ratio), Some(prune))
        })
    });
    let variants: Vec<Variant> = [variant("no pruning".into(), None)].into_iter().chain(pruned).collect();
    compare("prune", &variants)
}
