//! How far devices are, as they say themselves. Statuses are for people: nothing in the service depends on them.

use cosurf_contract::{AgentStatus, BadStatus};
use cosurf_link::mqtt::HeardStatus;
use cosurf_wire::DeviceId;
use serde::Serialize;

/// How far a device is, as it says itself.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct DeviceStatus {
    /// The device under whose topic the status arrived.
    pub device: DeviceId,
    /// What it says.
    pub status: AgentStatus,
    /// True if the broker had kept the status from earlier.
    #[serde(skip)]
    pub is_kept: bool,
}

impl DeviceStatus {
    /// Reads a status that anybody may have sent.
    pub(super) fn read(heard: &HeardStatus) -> Result<Self, BadStatus> {
        let status = AgentStatus::parse(&heard.payload)?;
        Ok(Self { device: heard.device, status, is_kept: heard.is_kept })
    }
}
