//! What the tests of several modules share: the faults of a simulated network, limits, and small models.
#![allow(clippy::unwrap_used)]

mod models;

use std::path::{Path, PathBuf};
use std::time::Duration;

use cosurf_engine::DeviceChoice;
use cosurf_link::{Faults, Identity, InboxLimits, Role};
use cosurf_wire::{DeviceId, SiteId};

use crate::merge::MergeSettings;
pub(crate) use models::{above, ground, model, model_at};

pub(crate) const BAD_WEATHER: Faults = Faults {
    loss: 0.1,
    duplication: 0.1,
    corruption: 0.05,
    delay_max: Duration::from_millis(80),
    ..Faults::NONE
};
pub(crate) const LIMITS: InboxLimits =
    InboxLimits { body_bytes_max: 1 << 24, total_bytes_max: 1 << 25, models_max: 8, stored_max: 8 };
/// Settings of a short merge.
pub(crate) const QUICK: MergeSettings = MergeSettings {
    epochs: 1,
    compress: true,
    refine: false,
    vouched: true,
    memory_bytes: 1 << 30,
    seed: 1,
    device: DeviceChoice::Cpu,
};
/// Time after which a test has failed; virtual time in simulations.
pub(crate) const PATIENCE: Duration = Duration::from_secs(300);

pub(crate) fn identity(site: &str, device: &str, role: Role) -> Identity {
    Identity { site: SiteId::new(site).unwrap(), device: DeviceId::new(device).unwrap(), session: 1, role }
}

/// The undulation of [`geoid`] at a longitude and latitude, metres.
pub(crate) fn undulation_m(longitude_deg: f64, latitude_deg: f64) -> f64 {
    30.0 + 2.0 * (longitude_deg - 16.0) - 3.0 * (latitude_deg - 53.0)
}

/// Writes a grid in the format of NOAA about 16.5° east, 53.5° north, and returns its path. The heights above a grid of this
/// name are EPSG:5773.
pub(crate) fn geoid(folder: &Path) -> PathBuf {
    let mut bytes = Vec::new();
    [53.0, 16.0, 0.5, 0.5].iter().for_each(|number| bytes.extend(f64::to_be_bytes(*number)));
    [3_u32, 3].iter().for_each(|count| bytes.extend(count.to_be_bytes()));
    for i in 0..9 {
        let at = [16.0 + 0.5 * f64::from(i % 3), 53.0 + 0.5 * f64::from(i / 3)];
        bytes.extend((undulation_m(at[0], at[1]) as f32).to_be_bytes());
    }
    let path = folder.join("egm96_15.gtx");
    std::fs::write(&path, bytes).unwrap();
    path
}
