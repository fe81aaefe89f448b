//! The figures of a mission, in the form that `report.json` has.

use std::path::PathBuf;

use cosurf_contract::{Curve, TrainReport};
use serde::{Deserialize, Serialize};

use crate::evaluate::Quality;
use crate::service::Merging;

/// All figures of a mission; the content of `report.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MissionReport {
    /// The dataset's folder.
    pub data: PathBuf,
    /// Seed of every random choice.
    pub seed: u64,
    /// The agents, in order of device id.
    pub agents: Vec<AgentSummary>,
    /// The edge aggregators, in order of device id.
    pub edges: Vec<EdgeSummary>,
    /// The mission as a whole.
    pub whole: WholeSummary,
}

/// The figures of one agent.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AgentSummary {
    /// Device id.
    pub device: String,
    /// Number of views that the agent trains on, including views of other cells that look at its margin.
    pub views: usize,
    /// Number of held-out views of the agent's cell. A held-out view belongs to the cell nearest to the centre
    /// of its footprint.
    pub held_out: usize,
    /// The figures of the agent's training; absent if it did not finish.
    pub training: Option<TrainReport>,
    /// Bytes sent to the aggregator, resends included.
    pub bytes_sent: u64,
    /// How often the agent's process died and was restarted.
    pub restarts: u32,
    /// Figures of the global model on this agent's held-out views; absent if the agent has none.
    pub in_global: Option<Quality>,
    /// Why the agent failed; absent if it did not.
    pub failure: Option<String>,
    /// The training curve, over all runs.
    pub curve: Curve,
}

/// The figures of one edge aggregator.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EdgeSummary {
    /// Device id of the edge on the site of the root aggregator.
    pub device: String,
    /// Device ids of the edge's agents.
    pub agents: Vec<String>,
    /// Bytes that the edge sent to the root for its last delivered revision, resends included.
    pub bytes_sent: u64,
    /// How the edge merged its agents' models; absent if it merged none.
    pub merging: Option<Merging>,
}

/// The figures of the whole mission.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct WholeSummary {
    /// Number of views that are trained on, by all agents together.
    pub views: usize,
    /// Number of views held out.
    pub held_out: usize,
    /// Number of splats of the global model.
    pub splats: usize,
    /// Revision of the global model.
    pub revision: u64,
    /// Number of training steps of all agents together.
    pub steps: u64,
    /// Time from the start of the mission until the global model is scored, seconds.
    pub seconds: f64,
    /// Training steps of all agents together, divided by the seconds of the longest training.
    pub steps_per_s: f64,
    /// Peak resident memory of the agent that used most, bytes.
    pub peak_memory_bytes: u64,
    /// Peak resident memory, bytes, of the process that runs the mission, all aggregators included; absent if the
    /// system does not report it.
    pub aggregator_peak_memory_bytes: Option<u64>,
    /// Bytes that all agents sent, resends included.
    pub bytes_sent: u64,
    /// Figures of the global model on all held-out views; absent if no view is held out, or if it was not scored.
    pub quality: Option<Quality>,
    /// Why the global model, or the joined one, was not scored; absent if both were.
    #[serde(default)]
    pub scores_failure: Option<String>,
    /// PSNR and SSIM, on all held-out views, of the agents' models joined but not merged; absent if no view
    /// is held out, or if they were not scored.
    pub joined: Option<Quality>,
    /// How the models were merged; absent if the record of the merge cannot be read.
    pub merging: Option<Merging>,
    /// The mesh of the global model; absent if none was made.
    pub mesh: Option<MeshSummary>,
    /// Why no mesh was made; absent if there is one.
    pub mesh_failure: Option<String>,
    /// Why the survey failed; absent if it was made, or if nothing tells where the model lies.
    #[serde(default)]
    pub survey_failure: Option<String>,
    /// How long each phase took, in their order.
    #[serde(default)]
    pub phases: Vec<PhaseTime>,
}

/// How long a phase of a mission took.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PhaseTime {
    /// What happened in it, in a few words.
    pub phase: String,
    /// Wall time, seconds.
    pub seconds: f64,
}

/// The figures of a mesh.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct MeshSummary {
    /// Number of triangles.
    pub triangles: usize,
    /// Edge of the voxels from which the mesh was extracted, world units.
    pub voxel_m: f64,
}
