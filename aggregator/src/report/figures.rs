//! The figures of a mission, as they stand in `report.json`.

use std::path::PathBuf;

use cosurf_contract::TrainReport;
use serde::{Deserialize, Serialize};

use crate::evaluate::Quality;
use crate::service::Merging;

/// The figures of a mission, as in `report.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MissionReport {
    /// The dataset's folder.
    pub data: PathBuf,
    /// Seed of every random choice.
    pub seed: u64,
    /// In order of device id.
    pub agents: Vec<AgentSummary>,
    /// The edge aggregators, in order of device id.
    pub edges: Vec<EdgeSummary>,
    /// The mission as a whole.
    pub whole: WholeSummary,
}

/// One agent's figures.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AgentSummary {
    /// Device id.
    pub device: String,
    /// Views given to train on.
    pub views: usize,
    /// Held-out views whose footprint centre lies in the agent's cell.
    pub held_out: usize,
    /// The figures of its training; absent if the training did not finish.
    pub training: Option<TrainReport>,
    /// Bytes sent to the aggregator, resends included.
    pub bytes_sent: u64,
    /// How often its process died and was restarted.
    pub restarts: u32,
    /// The global model on this agent's held-out views; absent where there are none.
    pub in_global: Option<Quality>,
    /// Why the agent failed; absent if it did not.
    pub failure: Option<String>,
    /// `[step, dB]`: PSNR over steps, each a mean over the latest training pictures.
    pub curve: Vec<[f32; 2]>,
}

/// One edge's figures.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EdgeSummary {
    /// Its id on the root's site.
    pub device: String,
    /// Device ids of its agents.
    pub agents: Vec<String>,
    /// Bytes sent to the root, resends included.
    pub bytes_sent: u64,
    /// How it merged its agents' models; absent if none arrived.
    pub merging: Option<Merging>,
}

/// The figures of the whole mission.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct WholeSummary {
    /// Views trained on, by all agents together.
    pub views: usize,
    /// Views held out.
    pub held_out: usize,
    /// Splats of the global model.
    pub splats: usize,
    /// Revision of the global model.
    pub revision: u64,
    /// Steps of all agents together.
    pub steps: u64,
    /// From the mission's start to its end, seconds.
    pub seconds: f64,
    /// Steps of all agents together per second of the longest training.
    pub steps_per_s: f64,
    /// Peak resident memory of the largest agent.
    pub peak_memory_bytes: u64,
    /// Peak resident memory of the aggregator; absent if the system does not report it.
    pub aggregator_peak_memory_bytes: Option<u64>,
    /// Bytes that all agents sent, resends included.
    pub bytes_sent: u64,
    /// The global model on all held-out views; absent where none is held out.
    pub quality: Option<Quality>,
    /// The agents' models joined but not merged, on the same views.
    pub joined: Option<Quality>,
    /// How the models were merged.
    pub merging: Option<Merging>,
    /// The mesh of the global model; absent where it has none.
    pub mesh: Option<MeshSummary>,
    /// Why there is no mesh.
    pub mesh_failure: Option<String>,
}

/// A mesh's figures.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct MeshSummary {
    /// Its triangles.
    pub triangles: usize,
    /// Edge of a voxel, world units.
    pub voxel_m: f64,
}
