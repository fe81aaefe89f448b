//! Why a mission did not end with a report.

use std::path::PathBuf;

use cosurf_scene::SceneError;
use cosurf_wire::{DeviceId, IdError};
use image::ImageError;

use super::plan::PlanError;
use super::town::TownError;
use crate::broker::BrokerError;
use crate::evaluate::YardstickError;
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
    Town(#[from] TownError),
    /// A name of the mission is none.
    #[error(transparent)]
    Name(#[from] IdError),
    /// A file could not be read or written.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// What the global model is to be measured by cannot be read.
    #[error(transparent)]
    Yardstick(#[from] YardstickError),
    /// The embedded broker did not start.
    #[error(transparent)]
    Broker(#[from] BrokerError),
    /// The service could not open its folder.
    #[error(transparent)]
    Service(#[from] ServiceError),
    /// The agent's executable is not there.
    #[error("{path} is missing: build it with `cargo build --release --workspace`")]
    NoAgent {
        /// Where it should be.
        path: PathBuf,
    },
    /// The broker cannot be reached.
    #[error("{reason}; gave up after {BROKER_ATTEMPTS_MAX} attempts: check --broker, or leave it out")]
    NoBroker {
        /// What the link said last.
        reason: String,
    },
    /// The aggregator's disk refused.
    #[error("{reason}; what arrived before is kept: free space, then run the same command again")]
    Disk {
        /// What the disk said.
        reason: String,
    },
    /// The person asked to stop.
    #[error("interrupted; what is done is kept: the same command goes on from there")]
    Interrupted,
    /// A defect of the service.
    #[error("the receiving service stopped by itself, a defect; the same command goes on from there")]
    ServiceDied,
    /// No agent sent a model.
    #[error("no model arrived; {device} failed: {reason}")]
    NothingArrived {
        /// The first agent that failed.
        device: DeviceId,
        /// Why.
        reason: String,
    },
    /// The report cannot be written.
    #[error("pictures of the report: {0}")]
    Pictures(#[from] ImageError),
    /// The report cannot be written as JSON.
    #[error("report.json: {0}")]
    Json(#[from] serde_json::Error),
}
