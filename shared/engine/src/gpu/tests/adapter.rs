//! The adapters that the tests use.

use crate::gpu::context::{Gpu, GpuChoice};

/// A file of the testkit. The testkit itself is no dependency of this crate's tests: they also run on 64-bit ARM, for which its
/// many dependencies would have to be compiled.
#[path = "../../../../../tests/src/skips.rs"]
#[allow(unreachable_pub)]
mod skips;

/// Opens the best adapter. If there is none, reports the test as skipped and returns `None`.
pub(super) fn gpu() -> Option<Gpu> {
    match Gpu::open(GpuChoice::Any) {
        Ok(gpu) => Some(gpu),
        Err(error) => {
            skips::skip("REQUIRE_GPU", error);
            None
        }
    }
}

/// The adapter of [`gpu`] twice: as it is, and with the passes that a software driver runs if it is a graphics card, or
/// the reverse. Empty if there is no adapter.
pub(super) fn both() -> Vec<Gpu> {
    gpu().map_or_else(Vec::new, |gpu| vec![gpu.disguised(), gpu])
}
