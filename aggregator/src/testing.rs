//! What the tests of several modules share: the faults of a simulated network, limits, and small models.
#![allow(clippy::unwrap_used)]

mod models;

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
