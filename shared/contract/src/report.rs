//! What an agent reports to the program that started it: events as JSON lines while the agent runs, and JSON files at
//! the end.

use std::fmt;
use std::path::PathBuf;

use cosurf_wire::ModelId;
use serde::{Deserialize, Serialize};

use crate::Curve;

/// One line of an agent's standard output under `--json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum AgentEvent {
    /// The agent has chosen the pictures to train on and to hold out, before it trains.
    ViewsChosen {
        /// What the choice follows.
        by: ChosenBy,
        /// Number of chosen pictures.
        pictures: usize,
        /// Number of all pictures of the dataset.
        of: usize,
        /// Whether an earlier run has made the choice: a training that was begun keeps its pictures.
        #[serde(default, skip_serializing_if = "std::ops::Not::not")]
        resumed: bool,
    },
    /// The agent waits until pictures have arrived in a folder, and are complete.
    Watching {
        /// The folder.
        folder: PathBuf,
        /// Why the flight that is there cannot be trained on, one line; `None` if there is none, or it is done.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        problem: Option<String>,
    },
    /// Progress of making a dataset from photographs.
    Ingesting {
        /// What is being done.
        stage: IngestStage,
        /// Number of photographs, or parts of the work, that are done.
        done: usize,
        /// Number of all of them.
        of: usize,
        /// Estimated time until the end of this stage, seconds; `None` if not known.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        seconds_left: Option<f32>,
        /// Whether an earlier run has done this stage.
        #[serde(default, skip_serializing_if = "std::ops::Not::not")]
        resumed: bool,
    },
    /// A photograph, a control point or a part of the flight is left out of the dataset.
    LeftOut {
        /// Its name.
        name: String,
        /// Why, and what to do about it, one line.
        reason: String,
    },
    /// A dataset was made from photographs and is on disk.
    Ingested {
        /// The figures.
        report: IngestReport,
    },
    /// All that a flight needs is there; `preflight` ends with it.
    Ready {
        /// What the training would begin with.
        report: ReadyReport,
    },
    /// Training has started, or resumed from a checkpoint.
    Started {
        /// Number of training views.
        views: usize,
        /// Number of held-out views.
        held_out: usize,
        /// Number of splats at the start.
        splats: usize,
        /// Number of all steps.
        steps: u32,
        /// Number of steps that the checkpoint had done; 0 without a checkpoint.
        resumed_at: u32,
    },
    /// Training progress.
    Progress {
        /// Number of steps done.
        step: u32,
        /// Number of all steps.
        steps: u32,
        /// Mean PSNR over the steps since the last `Progress` event, dB. Each step is scored on its training picture.
        psnr: f32,
        /// Current number of splats.
        splats: usize,
        /// Steps per second since the last `Progress` event.
        steps_per_s: f32,
        /// Estimated time left, seconds.
        seconds_left: f32,
    },
    /// The GPU was lost. Training resumes on the CPU from the last checkpoint.
    DeviceLost {
        /// The text of the error, with the reason that the driver gave.
        reason: String,
    },
    /// The checkpoint is damaged or of another training, and was renamed. Training starts again.
    CheckpointSetAside {
        /// What is wrong with it.
        reason: String,
        /// The path that it has now.
        kept: PathBuf,
    },
    /// Training has ended and the model is on disk.
    Trained {
        /// The figures.
        report: TrainReport,
    },
    /// Progress of training the base: a small model that is sent first and stands in for the whole model until all of
    /// it has arrived.
    Preparing {
        /// Number of steps done.
        step: u32,
        /// Number of all steps.
        steps: u32,
        /// Estimated time left, seconds.
        seconds_left: f32,
    },
    /// A temporary failure: the broker or the radio cannot be reached, the aggregator refuses the model for now, or the
    /// disk failed. The agent retries.
    Retrying {
        /// What failed and why, for example that the broker at an address refused the connection. JSON calls it
        /// `what`, as in version 0.1.
        #[serde(rename = "what")]
        reason: String,
        /// Number of failed attempts to connect since the last connection; 1 if the aggregator refuses the model or the
        /// disk failed.
        attempt: u32,
    },
    /// Before the upload, the agent dropped the splats of ground that other devices observed better.
    Compressed {
        /// Number of dropped splats; may be 0.
        removed: usize,
        /// Number of splats before the agent dropped any.
        of: usize,
        /// Number of other devices whose flights (announced cameras) have arrived and count.
        others: usize,
        /// Number of other devices whose flights have arrived and do not count, because the aggregator has not confirmed
        /// them. Always 0 without `trusted`.
        #[serde(default)]
        unconfirmed: usize,
    },
    /// Upload progress.
    Publishing {
        /// Bytes of the encoded model that have arrived at the aggregator.
        #[serde(default)]
        bytes_arrived: u64,
        /// Bytes of all messages sent so far, including retries.
        bytes_sent: u64,
        /// Size of the encoded model in bytes.
        bytes_total: u64,
    },
    /// The aggregator has stored the model on its disk.
    Acknowledged {
        /// Bytes of all messages sent, including retries.
        bytes_sent: u64,
    },
    /// A revision of the global model is stored on the agent's disk, by this run or by an earlier one.
    GlobalReceived {
        /// Number of the revision.
        revision: ModelId,
        /// Number of splats of the global model.
        splats: usize,
        /// Whether a key of the agent's list `trusted` has signed it. False without such a list: then anybody who can
        /// write to the broker may have made it.
        #[serde(default, skip_serializing_if = "std::ops::Not::not")]
        verified: bool,
    },
    /// The agent refused a revision of the global model, and does not wait for it.
    GlobalRefused {
        /// Number of the revision.
        revision: ModelId,
        /// The reason and the remedy, one line.
        reason: String,
    },
    /// The agent's model was compared with another model on the ground that the agent's cameras see.
    Compared {
        /// The other model.
        with: ComparedWith,
        /// The changes from the initial model to the agent's own model, or from the agent's own model to the global
        /// model.
        changes: Changes,
    },
}

/// What an agent's choice of pictures follows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ChosenBy {
    /// The agent's cell of the site's plan.
    Cell,
    /// The site's plan has no cell for the agent, so all pictures count.
    NoCell,
    /// No plan has arrived in time, so all pictures count.
    NoPlan,
    /// The lists `views` and `held_out` of the agent's configuration. They win over a cell.
    Configuration,
}

/// The model that an agent's own model is compared with.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ComparedWith {
    /// The model that training started from, for example the last flight's global model.
    Init,
    /// The newest global model that the agent has received.
    Global,
}

/// How much two models differ on the ground that an agent's cameras see. Below, *surface* means the pixels of the
/// compared renderings in which at least one of the two models shows a surface.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Changes {
    /// Number of cameras compared.
    pub views: usize,
    /// Mean PSNR between the renderings of the two models, dB. Each camera counts at most 99 dB.
    pub psnr: f64,
    /// Median relative difference of depth, at least 0, over the pixels that show a surface in both models; `None` if
    /// there is no such pixel.
    pub depth: Option<f64>,
    /// Share of the surface that both models show, but with depths that differ by more than 3 %, 0..=1.
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

/// What a training would begin with.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ReadyReport {
    /// Number of training views.
    pub views: usize,
    /// Number of held-out views.
    pub held_out: usize,
    /// Number of splats at the start.
    pub splats: usize,
    /// Largest width and largest height of the training pictures, px.
    pub size_px: [u32; 2],
    /// The device that would train, for example `cpu avx512 × 2`.
    pub device: String,
    /// The reductions that the memory limit would force, one line of text each; empty if there are none.
    pub given_up: Vec<String>,
}

/// The figures of one training, also the content of `report.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrainReport {
    /// Number of training steps.
    pub steps: u32,
    /// Training time over all runs, seconds.
    pub seconds: f64,
    /// CPU time of all threads during the training, seconds; 0 if the operating system does not report it.
    #[serde(default)]
    pub cpu_seconds: f64,
    /// `steps / seconds`.
    pub steps_per_s: f64,
    /// Number of splats of the model.
    pub splats: usize,
    /// Peak resident memory of the process, bytes; 0 if the operating system does not report it.
    pub peak_memory_bytes: u64,
    /// Mean PSNR over the held-out views, dB; `None` without held-out views.
    pub psnr: Option<f64>,
    /// Mean SSIM over the held-out views, -1..=1; `None` without held-out views.
    pub ssim: Option<f64>,
    /// Seed of all random numbers.
    pub seed: u64,
    /// The device that trained the model, for example `cpu avx512 × 2`.
    pub device: String,
    /// Number of training views.
    pub views: usize,
    /// Number of held-out views.
    pub held_out: usize,
    /// Largest width and largest height of the training pictures, px.
    pub size_px: [u32; 2],
    /// How far the median picture has moved, px, because its poses were learnt; `None` if they were taken as exact.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub poses_moved_px: Option<f64>,
    /// The reductions that the memory limit forced, one line of text each; empty if there were none.
    pub given_up: Vec<String>,
    /// The training curve, over all runs.
    #[serde(default)]
    pub curve: Curve,
}

/// A stage of making a dataset from photographs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum IngestStage {
    /// Reads the photographs and their GPS.
    Reading,
    /// Finds features in each photograph.
    Features,
    /// Finds the same features in pairs of photographs.
    Matches,
    /// Finds where each photograph was taken.
    Poses,
    /// Adjusts poses and lenses to GPS and control points.
    Adjusting,
    /// Removes the distortion of the lens.
    Undistorting,
}

/// Figures of making a dataset from photographs.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct IngestReport {
    /// Number of photographs in the folder.
    pub photographs: usize,
    /// Number of photographs in the dataset.
    pub posed: usize,
    /// Number of points of the sparse cloud.
    pub points: usize,
    /// Whether the dataset lies where it is on the earth; otherwise its scale and its place are unknown.
    pub georeferenced: bool,
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
