//! The adapter that the tests use.

use crate::gpu::context::{Gpu, GpuChoice};

/// Opens the best adapter. If there is none, reports the test as skipped and returns `None`.
pub(super) fn gpu() -> Option<Gpu> {
    match Gpu::open(GpuChoice::Any) {
        Ok(gpu) => Some(gpu),
        Err(error) => {
            cosurf_tests::skips::skip("REQUIRE_GPU", error);
            None
        }
    }
}
