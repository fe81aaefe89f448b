//! What a mission is told: what to do, and what only `main` knows of the machine.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use cosurf_link::BrokerAddress;
use cosurf_scene::city::CitySettings;

use super::plan::Settings;
use crate::terminal::Display;

/// A mission as ordered.
#[derive(Clone, Debug)]
pub struct MissionOrder {
    /// What decides the result; paths absolute.
    pub settings: Settings,
    /// The synthetic city to make first where the data should be; `None` where there are data.
    pub city: Option<CitySettings>,
    /// Where everything goes, absolute; made where it is missing.
    pub out: PathBuf,
    /// The broker to use; `None` for an embedded one on a free port of this machine.
    pub broker: Option<BrokerAddress>,
    /// Folder of LPIPS weights to judge the global model by too; `None` for no LPIPS.
    pub lpips: Option<PathBuf>,
}

/// What only a main knows of the world.
#[derive(Clone)]
pub struct Surroundings {
    /// Time since the program began.
    pub now: Arc<dyn Fn() -> Duration + Send + Sync>,
    /// Seconds since 1970 at the start: numbers the session, names the site of a fresh mission.
    pub session: u64,
    /// Cores to compute on, at least 1.
    pub cores: usize,
    /// The agent's executable.
    pub agent: PathBuf,
    /// How to show progress.
    pub display: Display,
    /// Set when the person wants to stop.
    pub interrupted: Arc<AtomicBool>,
    /// Peak resident memory of this process, where the system tells.
    pub peak_memory_bytes: fn() -> Option<u64>,
}
