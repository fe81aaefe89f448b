//! The inputs of a mission: what to do, and what only `main` knows about the machine.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use cosurf_city::CitySettings;
use cosurf_link::BrokerAddress;

use super::plan::Settings;
use crate::station::Board;
use crate::terminal::Display;

/// Which mission to run.
#[derive(Clone, Debug)]
pub struct MissionOrder {
    /// Settings that decide the result; paths are absolute.
    pub settings: Settings,
    /// How long it took to make the dataset of photographs, seconds; `None` if it was there.
    pub ingest_s: Option<f64>,
    /// The synthetic city to render first as the dataset; `None` if the dataset exists.
    pub city: Option<CitySettings>,
    /// The output folder, absolute; created if it is missing.
    pub out: PathBuf,
    /// The broker to use; `None` for an embedded one on a free port of this machine.
    pub broker: Option<BrokerAddress>,
    /// Grid of the geoid that the heights of the survey are above; `None` for heights above the ellipsoid.
    pub geoid: Option<PathBuf>,
    /// Folder of LPIPS weights; `None` to leave LPIPS out.
    pub lpips: Option<PathBuf>,
}

/// What only `main` may read from the system.
#[derive(Clone)]
pub struct Surroundings {
    /// Time since the program began.
    pub now: Arc<dyn Fn() -> Duration + Send + Sync>,
    /// Seconds since 1970 at the program's start. They are the number of the session, and part of a new
    /// mission's site name.
    pub session: u64,
    /// Cores to compute on, at least 1.
    pub cores: usize,
    /// The agent's executable.
    pub agent: PathBuf,
    /// How to show progress.
    pub display: Display,
    /// Where to note what happens, for people who look at it in a browser; `None` if nobody does.
    pub board: Option<Board>,
    /// Set when the user asks to stop.
    pub interrupted: Arc<AtomicBool>,
    /// Returns the peak resident memory of this process, bytes; `None` if the system does not report it.
    pub peak_memory_bytes: fn() -> Option<u64>,
}
