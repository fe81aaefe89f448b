//! What an operator can do to a running service.

use std::fmt;
use std::sync::Arc;

use cosurf_wire::DeviceId;

/// What an operator can do to a running service.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Action {
    /// Withdraw all models that a device has sent so far.
    Forget(DeviceId),
    /// Refuse a device from now on.
    Revoke {
        /// The device.
        device: DeviceId,
        /// Whether to withdraw its models as well.
        forget: bool,
    },
    /// Make an older revision the newest one.
    Restore(u64),
    /// Merge the models that have arrived, without waiting for others.
    Merge,
}

/// Does an action at the operator's request. The error is one line for the operator.
pub type Act = Arc<dyn Fn(&Action) -> Result<(), String> + Send + Sync>;

impl fmt::Display for Action {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Forget(device) => write!(f, "forget {device}"),
            Self::Revoke { device, forget: false } => write!(f, "revoke {device}"),
            Self::Revoke { device, forget: true } => write!(f, "revoke and forget {device}"),
            Self::Restore(revision) => write!(f, "restore revision {revision}"),
            Self::Merge => write!(f, "merge now"),
        }
    }
}
