//! The side of a worker: carries out the task of a tile that another computer has put into the store.

use std::path::Path;

use blake3::Hash;
use cosurf_engine::Device;

use super::computer::Computer;
use super::error::MergeError;
use super::learn::learn;
use super::results;
use super::task::{Task, name};
use crate::scratch::Scratch;
use crate::store::{ObjectError, Store};

/// What became of a task.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum CarriedOut {
    /// The tile was distilled.
    Distilled {
        /// Number of splats.
        splats: usize,
    },
    /// The result was there already, or the task is no longer wanted.
    Needless,
}

/// Carries out the task with this hash, and puts the result into the store. `goes_on` is called after each step; it
/// returns false to stop.
pub(crate) fn carry_out(
    hash: &Hash,
    store: &Store,
    scratch: &Path,
    device: &Device,
    threads: usize,
    memory_bytes: u64,
    goes_on: &dyn Fn() -> bool,
) -> Result<CarriedOut, MergeError> {
    if store.size(&hash.to_hex())?.is_some() {
        return Ok(CarriedOut::Needless);
    }
    let scratch = Scratch::new(scratch)?;
    let task = Task::get(store, hash, device, &scratch, memory_bytes)?;
    let Some(task) = task else { return Ok(CarriedOut::Needless) };
    let computer = Computer { device: device.clone(), threads };
    let learnt = learn(&task, &scratch, &computer, &|_| goes_on())?;
    results::keep(store, hash, &learnt)?;
    Ok(CarriedOut::Distilled { splats: learnt.len() })
}

/// Tells the merge that no worker can carry out a task.
pub(crate) fn give_up(store: &Store, hash: &Hash, reason: &str) -> Result<(), ObjectError> {
    match store.size(&name(hash))? {
        Some(_) => store.put(&name_of_failure(hash), reason.to_owned().into()),
        None => Ok(()), // the merge has ended
    }
}

/// Name of the object that says why a task failed.
pub(super) fn name_of_failure(hash: &Hash) -> String {
    format!("{}.failed", hash.to_hex())
}

/// Why a task failed.
pub(super) fn failure(store: &Store, hash: &Hash) -> Result<String, ObjectError> {
    let reason = store.get(&name_of_failure(hash))?.unwrap_or_default();
    Ok(String::from_utf8_lossy(&reason[..reason.len().min(1000)]).into_owned())
}
