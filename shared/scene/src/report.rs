//! What an agent says of its work: events as JSON lines while it runs, a report when it is done.
//! Whoever starts agents (a person's script, the aggregator's `mission`) reads these.

use std::fmt;

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
    /// What goes out first is taught to stand in for the whole model.
    Preparing {
        /// Steps done.
        step: u32,
        /// Steps to do in all.
        steps: u32,
        /// Estimate of the time left, seconds.
        seconds_left: f32,
    },
    /// Something outside did not answer; the agent tries again.
    Retrying {
        /// What is tried, for example the broker's address.
        what: String,
        /// How often it was tried so far.
        attempt: u32,
    },
    /// Ground that other devices show as well was left to its owners before the upload.
    Compressed {
        /// Splats that are not sent.
        removed: usize,
        /// Splats of the model.
        of: usize,
        /// Devices whose flights are known.
        others: usize,
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
    /// The ground of the agent's own cameras was compared in two models.
    Compared {
        /// The other model: that which training began with, or the global model.
        with: Other,
        /// From the one to the agent's own, or from its own to the global one.
        changes: Changes,
    },
}

/// What an agent's own model is compared with.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Other {
    /// What training began with, for example the last flight's global model.
    Init,
    /// The global model that came back.
    Global,
}

/// How much two models differ on the ground that an agent's cameras see.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Changes {
    /// Cameras that were compared.
    pub views: usize,
    /// Mean PSNR of the one model's pictures against the other's, dB.
    pub psnr: f64,
    /// By what share depths differ, in the median; absent where nowhere both show a surface.
    pub depth: Option<f64>,
    /// Share of the surface that lies more than 3 % of its depth elsewhere, 0..=1.
    pub moved: f64,
    /// Share of the surface that only the first model shows.
    pub gone: f64,
    /// Share of the surface that only the second model shows.
    pub new: f64,
}

impl fmt::Display for Changes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let percent = |share: f64| format!("{:.1} %", 100.0 * share);
        let Self { psnr, moved, gone, new, .. } = *self;
        write!(f, "pictures {psnr:.1} dB alike, ")?;
        if let Some(depth) = self.depth {
            write!(f, "depth {:.2} % off in the median, ", 100.0 * depth)?;
        }
        write!(f, "{} of the surface moved, {} gone, {} new", percent(moved), percent(gone), percent(new))
    }
}

/// The figures of one training, also `report.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrainReport {
    /// Steps done.
    pub steps: u32,
    /// Time spent training, seconds, earlier sittings included.
    pub seconds: f64,
    /// Processor time of that, all threads, seconds; 0 where the system does not tell.
    #[serde(default)]
    pub cpu_seconds: f64,
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
