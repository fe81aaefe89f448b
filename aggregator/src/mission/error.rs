//! Why a mission did not end with a report.

use std::path::PathBuf;

use cosurf_engine::ViewError;
use cosurf_scene::SceneError;
use cosurf_wire::{DeviceId, IdError};
use image::ImageError;

use super::city::MakeCityError;
use super::plan::PlanError;
use crate::broker::BrokerError;
use crate::evaluate::YardstickError;
use crate::georeference::GeoreferenceError;
use crate::report::ShowcaseError;
use crate::service::{BROKER_ATTEMPTS_MAX, ServiceError};

/// Why a mission did not end with a report.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MissionError {
    /// No plan could be made.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// The city could not be made.
    #[error(transparent)]
    City(#[from] MakeCityError),
    /// The name of a site or device is not valid.
    #[error(transparent)]
    Name(#[from] IdError),
    /// A file could not be read or written.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The georeference of the dataset is wrong.
    #[error(transparent)]
    Georeference(#[from] GeoreferenceError),
    /// A picture for the report cannot be rendered.
    #[error(transparent)]
    View(#[from] ViewError),
    /// The LPIPS weights or the true surface cannot be read.
    #[error(transparent)]
    Yardstick(#[from] YardstickError),
    /// The built-in broker did not start.
    #[error(transparent)]
    Broker(#[from] BrokerError),
    /// The service could not open its folder.
    #[error(transparent)]
    Service(#[from] ServiceError),
    /// The agent's executable is missing.
    #[error("{path} is missing: build it with `cargo build --release --workspace`")]
    NoAgent {
        /// The path at which it should be.
        path: PathBuf,
    },
    /// The broker cannot be reached.
    #[error(
        "{reason}; gave up after {BROKER_ATTEMPTS_MAX} attempts: check --broker, or leave it out to start a built-in broker"
    )]
    NoBroker {
        /// The last error of the connection.
        reason: String,
    },
    /// The memory for merges is too small for the pictures.
    #[error("the memory for merges is too small for pictures of this size: allow at least {0} MiB (--merge-memory {0}MiB), or use smaller pictures (--max-size)", needed_bytes.div_ceil(1 << 20))]
    LittleMergeMemory {
        /// A limit below which no merge is possible, bytes.
        needed_bytes: u64,
    },
    /// The aggregator cannot write to its disk, or has too little memory for a merge.
    #[error("{reason}; models that arrived before are kept: mend this, then run the same command again")]
    Disk {
        /// What failed.
        reason: String,
    },
    /// The user asked to stop.
    #[error("interrupted; run the same command again to resume the mission")]
    Interrupted,
    /// An aggregator ended because of a bug.
    #[error(
        "an aggregator stopped unexpectedly, which is a bug; run the same command again to resume the mission"
    )]
    ServiceDied,
    /// No agent sent a model.
    #[error("no model arrived; {device} failed: {reason}")]
    NothingArrived {
        /// The first agent that failed.
        device: DeviceId,
        /// Why that agent failed.
        reason: String,
    },
    /// The pictures of the report cannot be encoded.
    #[error("cannot encode the pictures of the report: {0}")]
    Pictures(#[from] ImageError),
    /// The report cannot be written as JSON.
    #[error("cannot write report.json: {0}")]
    Json(#[from] serde_json::Error),
}

impl From<ShowcaseError> for MissionError {
    fn from(error: ShowcaseError) -> Self {
        match error {
            ShowcaseError::View(error) => error.into(),
            ShowcaseError::Picture(error) => error.into(),
        }
    }
}
