//! What the owner of a service gives to the service: its configuration, and commands while it runs.

use std::path::PathBuf;

use cosurf_link::{Identity, InboxLimits};
use cosurf_wire::DeviceId;

use super::round::Expected;
use crate::merge::MergeSettings;

/// Number of attempts to reach the broker for the first time, after which the caller should give up. After
/// the first connection there is no limit, so that a service survives an outage of its broker.
pub(crate) const BROKER_ATTEMPTS_MAX: u32 = 8;

/// Configuration of a service.
#[derive(Clone, Debug)]
pub struct ServiceConfig {
    /// Site, device id and role of the service.
    pub identity: Identity,
    /// The service's folder; see [`crate::service`] for its content.
    pub folder: PathBuf,
    /// Limits on the uploads that the service receives.
    pub limits: InboxLimits,
    /// When to merge models.
    pub expected: Expected,
    /// How to merge models.
    pub merge: MergeSettings,
    /// Threads to merge with, at least 1.
    pub threads: usize,
}

/// A command to a running service.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Command {
    /// Do not wait for this device any more. Models that it has sent still count.
    GiveUp(DeviceId),
    /// Finish a merge that is due, then end.
    Finish,
    /// End at once. A running merge starts over when the service starts again.
    Stop,
}
