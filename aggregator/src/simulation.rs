//! What tests of whole fleets share: the weather, the limits, and small models.
#![allow(clippy::unwrap_used)]

use std::time::Duration;

use cosurf_engine::DeviceChoice;
use cosurf_link::{Faults, Identity, InboxLimits, Model, Role};
use cosurf_wire::{DeviceId, SiteId};

use crate::merge::MergeSettings;
use crate::merge::tests::{above, ground};

pub(crate) const BAD_WEATHER: Faults = Faults {
    loss: 0.1,
    duplication: 0.1,
    corruption: 0.05,
    delay_max: Duration::from_millis(80),
    ..Faults::NONE
};
pub(crate) const LIMITS: InboxLimits =
    InboxLimits { body_bytes_max: 1 << 24, total_bytes_max: 1 << 25, models_max: 8, stored_max: 8 };
/// A merge that takes no longer than it must.
pub(crate) const QUICK: MergeSettings = MergeSettings {
    epochs: 1,
    compress: true,
    refine: false,
    memory_bytes: 1 << 30,
    seed: 1,
    device: DeviceChoice::Cpu,
};
/// Virtual time after which a test has failed.
pub(crate) const PATIENCE: Duration = Duration::from_secs(300);

pub(crate) fn identity(site: &str, device: &str, role: Role) -> Identity {
    Identity { site: SiteId::new(site).unwrap(), device: DeviceId::new(device).unwrap(), session: 1, role }
}

/// A small model of the ground at `place`, seen by two small cameras.
pub(crate) fn model_at(place: f32) -> Model {
    let cameras = [-0.5, 0.5].map(|x| above(f64::from(place) + x).resized([24, 16]));
    Model { splats: ground(place - 2.0, place + 2.0), cameras: cameras.to_vec() }
}
