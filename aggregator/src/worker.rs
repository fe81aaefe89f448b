//! A worker: distils tiles for merges that run on other computers. Any number of workers may share a queue and a store;
//! they may be killed and started at any time.
//!
//! What it knows nothing about: sites, devices and models. A task has all that decides its result.
//!
//! Where to start reading: [`work`].

use std::fmt;
use std::path::PathBuf;
use std::thread;
use std::time::{Duration, Instant};

use blake3::Hash;
use cosurf_engine::Device;
use serde::Serialize;

use crate::merge::{CarriedOut, MergeError, carry_out, give_up};
use crate::queue::{Delivered, Queue, QueueError};
use crate::store::Store;

/// A task that was delivered so often is given up.
const DELIVERIES_MAX: u64 = 5;
/// Pause before a task that failed is delivered again, and before a queue that is away is asked again.
const RETRY: Duration = Duration::from_secs(2);

/// What a worker works with.
#[derive(Clone, Debug)]
pub struct WorkerSettings {
    /// The computing device.
    pub device: Device,
    /// Number of CPU threads, at least 1.
    pub threads: usize,
    /// Limit on the memory, bytes. Tasks that need more are left to other workers.
    pub memory_bytes: u64,
    /// Folder for files with what does not stay in memory.
    pub scratch: PathBuf,
}

/// What a worker reports.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum WorkerEvent {
    /// The worker waits for tasks for devices of this class.
    Ready {
        /// Class of the device.
        class: String,
    },
    /// A tile was distilled.
    Distilled {
        /// Hash of the task.
        task: String,
        /// Number of splats.
        splats: usize,
        /// Time that it took, seconds.
        seconds: f64,
    },
    /// A task failed. It is delivered again, unless this was the last time.
    Failed {
        /// Hash of the task.
        task: String,
        /// Why.
        reason: String,
        /// Whether no worker gets it again.
        is_given_up: bool,
    },
    /// The queue does not answer. The worker asks again.
    QueueAway {
        /// Why.
        reason: String,
    },
}

impl fmt::Display for WorkerEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Ready { class } => write!(f, "waiting for tiles ({class})"),
            Self::Distilled { task, splats, seconds } => {
                write!(f, "tile {}: {splats} splats in {seconds:.1} s", short(task))
            }
            Self::Failed { task, reason, is_given_up: false } => {
                write!(f, "tile {} failed and will be tried again: {reason}", short(task))
            }
            Self::Failed { task, reason, is_given_up: true } => {
                write!(f, "tile {} is given up: {reason}", short(task))
            }
            Self::QueueAway { reason } => write!(f, "{reason}; trying again"),
        }
    }
}

fn short(task: &str) -> &str {
    task.get(..12).unwrap_or(task)
}

/// Distils tiles until `is_stopped` returns true. A task that is stopped is given to another worker.
pub fn work(
    queue: &Queue,
    store: &Store,
    settings: &WorkerSettings,
    is_stopped: &dyn Fn() -> bool,
    tell: &mut dyn FnMut(WorkerEvent),
) {
    let class = settings.device.class();
    tell(WorkerEvent::Ready { class: class.clone() });
    let mut is_away = false;
    while !is_stopped() {
        let worked = match queue.take(&class) {
            Ok(Some(delivered)) => attend(delivered, store, settings, is_stopped, tell),
            taken => taken.map(|_| ()),
        };
        if let Err(error) = &worked {
            if !is_away {
                tell(WorkerEvent::QueueAway { reason: error.to_string() });
            }
            thread::sleep(RETRY);
        }
        is_away = worked.is_err();
    }
}

/// Carries out a task that was delivered.
fn attend(
    delivered: Delivered,
    store: &Store,
    settings: &WorkerSettings,
    is_stopped: &dyn Fn() -> bool,
    tell: &mut dyn FnMut(WorkerEvent),
) -> Result<(), QueueError> {
    let (task, begun) = (delivered.task.clone(), Instant::now());
    let Ok(hash) = Hash::from_hex(&task) else { return delivered.finish() };
    let store = store.folder(&delivered.folder);
    let outcome = match delivered.deliveries {
        0..=DELIVERIES_MAX => attempt(&hash, &store, settings, is_stopped),
        _ => Err(format!("{DELIVERIES_MAX} workers ended before it was done")),
    };
    let reason = match outcome {
        Ok(CarriedOut::Needless) => return delivered.finish(),
        Ok(CarriedOut::Distilled { splats }) => {
            tell(WorkerEvent::Distilled { task, splats, seconds: begun.elapsed().as_secs_f64() });
            return delivered.finish();
        }
        Err(_) if is_stopped() => return delivered.give_back(Duration::ZERO),
        Err(reason) => reason,
    };
    let is_given_up = delivered.deliveries >= DELIVERIES_MAX && give_up(&store, &hash, &reason).is_ok();
    tell(WorkerEvent::Failed { task, reason, is_given_up });
    if is_given_up { delivered.finish() } else { delivered.give_back(RETRY) }
}

/// The error is the reason of the failure.
fn attempt(
    hash: &Hash,
    store: &Store,
    settings: &WorkerSettings,
    is_stopped: &dyn Fn() -> bool,
) -> Result<CarriedOut, String> {
    let WorkerSettings { device, threads, memory_bytes, scratch } = settings;
    let done: Result<CarriedOut, MergeError> =
        carry_out(hash, store, scratch, device, *threads, *memory_bytes, &|| !is_stopped());
    done.map_err(|error| error.to_string())
}
