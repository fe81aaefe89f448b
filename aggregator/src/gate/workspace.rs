//! What the gate may use.

use std::path::Path;

use crate::merge::MergeSettings;
use crate::merge::shifts::Shifts;

/// Bytes of the pictures that a job keeps beside its models. Measured: two jobs with models of 59,000 splats each take
/// 19 MiB more than the models do.
const PICTURES_BYTES: u64 = 12 << 20;

/// What the gate may use.
#[derive(Clone, Copy, Debug)]
pub struct Workspace<'a> {
    /// Folder for files; none is left at the end.
    pub scratch: &'a Path,
    /// Number of CPU threads, at least 1.
    pub threads: usize,
    /// Limit on the bytes that the process takes. It decides how many models are compared at once, and does not change
    /// the result. Models of which not even two fit are refused.
    pub memory_bytes: u64,
}

impl<'a> Workspace<'a> {
    /// The workspace of a merge with these settings.
    pub fn of(settings: &MergeSettings, scratch: &'a Path, threads: usize) -> Self {
        Self { scratch, threads, memory_bytes: settings.memory_bytes }
    }

    /// How jobs whose models take up to `models_bytes` each are shared among the threads.
    pub(super) fn shifts(&self, models_bytes: u64) -> Shifts {
        Shifts::of(models_bytes + PICTURES_BYTES, self.memory_bytes, self.threads)
    }
}
