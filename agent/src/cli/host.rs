//! Default values that depend on the computer: the number of threads and the memory limit.

use std::thread::available_parallelism;

/// Number of CPU cores that this process may use; 1 if it is unknown.
pub(super) fn cores() -> usize {
    available_parallelism().map_or(1, usize::from)
}

/// The memory limit in bytes if the user gives none: two thirds of the free memory, at most 8 GiB. If the free memory
/// is unknown, 2 GiB.
pub(super) fn default_memory() -> u64 {
    cosurf_agent::usage::available_bytes().map_or(2 << 30, |free| free / 3 * 2).min(8 << 30)
}
