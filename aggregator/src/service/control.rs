//! What the owner of a service gives it: its configuration, and commands while it runs.

use std::path::PathBuf;

use cosurf_link::{Identity, InboxLimits};
use cosurf_wire::DeviceId;

use super::round::Expected;
use crate::merge::MergeSettings;

/// Attempts to reach the broker before the caller should give up. Once connected, there is no limit: a
/// service outlasts a broker that is down.
pub(crate) const BROKER_ATTEMPTS_MAX: u32 = 8;

/// Configuration of a service.
#[derive(Clone, Debug)]
pub struct ServiceConfig {
    /// Site, device and role under which it joins the link.
    pub identity: Identity,
    /// The service's folder; see [`crate::service`] for its content.
    pub folder: PathBuf,
    /// Limits on what it receives.
    pub limits: InboxLimits,
    /// When to merge models.
    pub expected: Expected,
    /// How to merge them.
    pub merge: MergeSettings,
    /// Threads to merge with, at least 1.
    pub threads: usize,
}

/// A command to a running service.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Command {
    /// Do not wait for this device any more; what it sent still counts.
    GiveUp(DeviceId),
    /// Merge what is due, then end.
    Finish,
    /// End at once; a running merge starts over at the next start.
    Stop,
}
