//! What an agent reports: events as JSON lines while it runs, and JSON files when it is done. The program that
//! started the agent reads them.

use std::fmt;

use cosurf_wire::ModelId;
use serde::{Deserialize, Serialize};

/// One line of an agent's standard output under `--json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum AgentEvent {
    /// Training has started, or resumed from a checkpoint.
    Started {
        /// Training views.
        views: usize,
        /// Held-out views.
        held_out: usize,
        /// Splats at the start.
        splats: usize,
        /// Total steps.
        steps: u32,
        /// Step of the checkpoint, 0 without one.
        resumed_at: u32,
    },
    /// Training progress.
    Progress {
        /// Steps done.
        step: u32,
        /// Total steps.
        steps: u32,
        /// Mean PSNR in dB over the training pictures since the last such event.
        psnr: f32,
        /// Current number of splats.
        splats: usize,
        /// Steps per second since the last such event.
        steps_per_s: f32,
        /// Estimated time left, seconds.
        seconds_left: f32,
    },
    /// The GPU was lost; training resumes from the last checkpoint on the CPU.
    DeviceLost {
        /// The device and the driver's reason.
        reason: String,
    },
    /// Training has ended and the model is on disk.
    Trained {
        /// The figures.
        report: TrainReport,
    },
    /// Progress of training the base, the small model that is sent first.
    Preparing {
        /// Steps done.
        step: u32,
        /// Total steps.
        steps: u32,
        /// Estimated time left, seconds.
        seconds_left: f32,
    },
    /// Something outside the agent does not answer; the agent retries.
    Retrying {
        /// What does not answer, for example the broker with its address.
        what: String,
        /// Attempts so far.
        attempt: u32,
    },
    /// Splats of ground that other devices observed better were dropped before the upload.
    Compressed {
        /// Dropped splats.
        removed: usize,
        /// Splats of the whole model.
        of: usize,
        /// Other devices whose views are known.
        others: usize,
    },
    /// Upload progress.
    Publishing {
        /// Bytes sent so far, including repetitions.
        bytes_sent: u64,
        /// Size of the model in bytes.
        bytes_total: u64,
    },
    /// The aggregator has stored the model on its disk.
    Acknowledged {
        /// Bytes sent, including repetitions.
        bytes_sent: u64,
    },
    /// A revision of the global model is stored on the agent's disk.
    GlobalReceived {
        /// The revision.
        revision: ModelId,
        /// Splats of the global model.
        splats: usize,
    },
    /// The agent's model was compared with another model on the ground that the agent's cameras see.
    Compared {
        /// The other model.
        with: ComparedWith,
        /// From the initial model to the agent's, or from the agent's to the global model.
        changes: Changes,
    },
}

/// The model that an agent's own model is compared with.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ComparedWith {
    /// The model that training started from, for example the last flight's global model.
    Init,
    /// The global model of this mission.
    Global,
}

/// How much two models differ on the ground that an agent's cameras see.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Changes {
    /// Number of cameras compared.
    pub views: usize,
    /// Mean PSNR between the two models' renderings, dB.
    pub psnr: f64,
    /// Median relative difference of depth, 0..; absent if no pixel shows a surface in both models.
    pub depth: Option<f64>,
    /// Share of the surface whose depth differs by more than 3 %, 0..=1.
    pub moved: f64,
    /// Share of the surface that only the first model shows, 0..=1.
    pub gone: f64,
    /// Share of the surface that only the second model shows, 0..=1.
    pub new: f64,
}

impl fmt::Display for Changes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let percent = |share: f64| format!("{:.1} %", 100.0 * share);
        let Self { psnr, moved, gone, new, .. } = *self;
        write!(f, "renderings agree to {psnr:.1} dB, ")?;
        if let Some(depth) = self.depth {
            write!(f, "median depth difference {:.2} %, ", 100.0 * depth)?;
        }
        write!(f, "{} of the surface moved, {} gone, {} new", percent(moved), percent(gone), percent(new))
    }
}

/// The figures of one training, also the content of `report.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrainReport {
    /// Steps done.
    pub steps: u32,
    /// Training time over all runs, seconds.
    pub seconds: f64,
    /// CPU time of all threads during that time, seconds; 0 if the operating system does not report it.
    #[serde(default)]
    pub cpu_seconds: f64,
    /// `steps / seconds`.
    pub steps_per_s: f64,
    /// Splats of the model.
    pub splats: usize,
    /// Peak resident memory of the process.
    pub peak_memory_bytes: u64,
    /// Mean PSNR over the held-out views, dB; absent without such views.
    pub psnr: Option<f64>,
    /// Mean SSIM over the held-out views, -1..=1; absent without such views.
    pub ssim: Option<f64>,
    /// Seed of all random numbers.
    pub seed: u64,
    /// The device that trained the model, for example `cpu avx512 × 2`.
    pub device: String,
    /// Training views.
    pub views: usize,
    /// Held-out views.
    pub held_out: usize,
    /// Width and height of the largest training picture.
    pub size_px: [u32; 2],
    /// What the memory limit ruled out, one sentence each; empty if nothing.
    pub given_up: Vec<String>,
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn json_of_earlier_versions_is_read_and_written_unchanged() {
        for line in [
            r#"{"event":"retrying","what":"broker 127.0.0.1:1883","attempt":2}"#,
            r#"{"event":"acknowledged","bytes_sent":4096}"#,
            r#"{"event":"global_received","revision":3,"splats":1000}"#,
            r#"{"event":"compared","with":"init","changes":{"views":16,"psnr":30.5,"depth":0.01,"moved":0.02,"gone":0.0,"new":0.1}}"#,
        ] {
            let event: AgentEvent = serde_json::from_str(line).unwrap();
            assert_eq!(serde_json::to_string(&event).unwrap(), line);
        }
    }

    #[test]
    fn a_report_without_cpu_time_is_read() {
        let json = r#"{"steps":7,"seconds":1.0,"steps_per_s":7.0,"splats":9,"peak_memory_bytes":1,"psnr":null,
            "ssim":null,"seed":0,"device":"cpu","views":2,"held_out":0,"size_px":[4,3],"given_up":[]}"#;
        let report: TrainReport = serde_json::from_str(json).unwrap();
        assert_eq!((report.cpu_seconds, report.size_px), (0.0, [4, 3]));
    }
}
