//! What is benched where nobody says otherwise.

use std::path::{Path, PathBuf};

use anyhow::Result;
use cosurf_city::{City, CitySettings};

/// `../shared/data/gt_boruszyn` where it lies beside the checkout, otherwise a small town made in `folder`.
pub(super) fn usual_data(folder: &Path) -> Result<PathBuf> {
    let scene = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data/gt_boruszyn");
    if scene.is_dir() {
        return Ok(scene);
    }
    let city = CitySettings { extent_m: 80.0, views: 48, ..CitySettings::default() };
    City::build(&city)?.write(folder, |_, _| ())?;
    Ok(folder.into())
}
