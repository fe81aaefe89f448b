//! Measures the gain in quality and the cost in time of each surface loss (CoSurfGS, "Ablations of Geometry Loss in
//! Device-side Training").
//!
//! `cargo bench -p cosurf-tests --bench geometry -- --help`

mod ablation;
mod surface;

use ablation::{Variant, compare};
use anyhow::Result;
use cosurf_engine::{PruneSettings, SurfaceSettings};

fn main() -> Result<()> {
    let all = SurfaceSettings::default();
    let variant = |name: &str, surface: Option<SurfaceSettings>| Variant {
        name: name.into(),
        surface,
        prune: Some(PruneSettings::default()),
    };
    compare(
        "geometry",
        &[
            variant("colour only", None),
            variant(
                "single view: flat splats, normals",
                Some(SurfaceSettings { reprojection: 0.0, ncc: 0.0, ..all }),
            ),
            variant("two views, without the smooth weight", Some(SurfaceSettings { smooth: false, ..all })),
            variant("two views, with the smooth weight (default)", Some(all)),
        ],
    )
}
