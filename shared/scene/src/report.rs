//! What an agent says of its work: events as JSON lines while it runs, a report when it is done.
//! Whoever starts agents (a person's script, the aggregator's `mission`) reads these.

use serde::{Deserialize, Serialize};

/// One line of an agent's standard output under `--json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum AgentEvent {
    /// Training begins or goes on.
    Started {
        /// Views trained on.
        views: usize,
        /// Views held out.
        held_out: usize,
        /// Splats at the start.
        splats: usize,
        /// Steps to do in all.
        steps: u32,
        /// Step of the checkpoint it goes on from, 0 for a fresh start.
        resumed_at: u32,
    },
    /// Training goes on.
    Progress {
        /// Steps done.
        step: u32,
        /// Steps to do in all.
        steps: u32,
        /// Mean PSNR in dB over the training pictures seen lately.
        psnr: f32,
        /// Splats now.
        splats: usize,
        /// Rate over the last interval.
        steps_per_s: f32,
        /// Estimate of the time left, seconds.
        seconds_left: f32,
    },
    /// The graphics card was lost; the processor goes on from the last checkpoint.
    DeviceLost {
        /// What was lost, and why.
        reason: String,
    },
    /// Training ended, the model is on disk.
    Trained {
        /// The figures.
        report: TrainReport,
    },
    /// Something outside did not answer; the agent tries again.
    Retrying {
        /// What is tried, for example the broker's address.
        what: String,
        /// How often it was tried so far.
        attempt: u32,
    },
    /// The upload goes on.
    Publishing {
        /// Bytes sent so far, resends included.
        bytes_sent: u64,
        /// Bytes of the model.
        bytes_total: u64,
    },
    /// The aggregator has the model safe on its disk.
    Acknowledged {
        /// Bytes sent, resends included.
        bytes_sent: u64,
    },
    /// A revision of the global model is safe on the agent's disk.
    GlobalReceived {
        /// Revision number.
        revision: u64,
        /// Splats of the global model.
        splats: usize,
    },
}

/// The figures of one training, also `report.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrainReport {
    /// Steps done.
    pub steps: u32,
    /// Time spent training, seconds, earlier sittings included.
    pub seconds: f64,
    /// `steps / seconds`.
    pub steps_per_s: f64,
    /// Splats of the model.
    pub splats: usize,
    /// Peak resident memory of the process.
    pub peak_memory_bytes: u64,
    /// Mean PSNR in dB over the held-out views; absent where none is held out.
    pub psnr: Option<f64>,
    /// Mean SSIM over the held-out views; absent where none is held out.
    pub ssim: Option<f64>,
    /// Seed of every random choice.
    pub seed: u64,
    /// What computed it, for example `cpu avx512 × 2`.
    pub device: String,
    /// Views trained on.
    pub views: usize,
    /// Views held out.
    pub held_out: usize,
    /// Size of the largest picture trained on.
    pub size_px: [u32; 2],
    /// What the memory budget took away, one sentence each; empty where nothing was given up.
    pub given_up: Vec<String>,
}
