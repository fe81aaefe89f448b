//! The state of a site as pages and scripts read it: the JSON of `/api/state` and of each event.

use cosurf_contract::AgentStatus;
use serde::Serialize;

use crate::merge::MergeProgress;

/// The state of a site, or what has changed of it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct State {
    /// False if only the devices and lines that have changed since the reader's last event are listed.
    pub(super) is_whole: bool,
    /// Seconds since the program began.
    pub(super) uptime_s: f64,
    /// Whether the broker is reached.
    pub(super) is_connected: bool,
    /// Progress of the merge that is running; absent if none is.
    pub(super) merge: Option<MergeProgress>,
    /// The newest revision; absent before the first.
    pub(super) revision: Option<Revision>,
    /// The devices, by name.
    pub(super) devices: Vec<DeviceState>,
    /// The newest lines of the log, oldest first.
    pub(super) log: Vec<Line>,
    /// Number of events so far.
    pub(super) events: u64,
}

/// The state of a device.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct DeviceState {
    /// Its name.
    pub(super) device: String,
    /// Its colour, as style sheets name it: the same in the map, in the model and in reports.
    pub(super) color: String,
    /// Seconds since it was last heard; absent if only its models are known.
    pub(super) heard_s_ago: Option<f64>,
    /// How far it is, as it says itself; absent if it has not said so.
    pub(super) status: Option<AgentStatus>,
    /// Some points of its training curve, `[step, PSNR in dB]`.
    pub(super) curve: Vec<[f64; 2]>,
    /// Number of its newest model that is stored; absent before the first.
    pub(super) model: Option<u64>,
    /// Number of models that have arrived since the program began.
    pub(super) uploads: u64,
    /// True if the operator has revoked it.
    pub(super) is_revoked: bool,
    /// True if the operator has withdrawn its models, and none has arrived since.
    pub(super) is_withdrawn: bool,
    /// Why its model is kept out of the newest revision; absent if it is not.
    pub(super) kept_out: Option<String>,
}

/// A revision of the global model.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct Revision {
    /// Its number.
    pub(super) revision: u64,
    /// Number of splats.
    pub(super) splats: usize,
    /// Number of local models that were merged.
    pub(super) models: usize,
    /// The older revision that it repeats, because the operator has restored that; absent if it was merged.
    pub(super) restored_from: Option<u64>,
    /// True once its report is in the folder.
    pub(super) is_reported: bool,
}

/// A line of the log.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct Line {
    /// Seconds since the program began.
    pub(super) at_s: f64,
    pub(super) text: String,
}
