//! What each loss of the surface brings and costs (CoSurfGS, "Ablations of Geometry Loss in Device-side
//! Training").
//!
//! `cargo bench -p cosurf-tests --bench geometry -- --help`

mod ablation;

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
    compare(&[
        variant("colour only", None),
        variant(
            "one view: flat splats, normals",
            Some(SurfaceSettings { reprojection: 0.0, ncc: 0.0, ..all }),
        ),
        variant("and two views: no smooth weight", Some(SurfaceSettings { smooth: false, ..all })),
        variant("and the smooth weight", Some(all)),
    ])
}
