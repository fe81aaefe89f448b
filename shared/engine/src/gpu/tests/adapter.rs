//! The adapter that the tests use.

use crate::gpu::context::{Gpu, GpuChoice};

/// The best adapter; without one, prints that the test is skipped and returns `None`.
pub(super) fn gpu() -> Option<Gpu> {
    match Gpu::open(GpuChoice::Any) {
        Ok(gpu) => Some(gpu),
        Err(error) => {
            assert!(std::env::var_os("REQUIRE_GPU").is_none(), "REQUIRE_GPU is set, but {error}");
            eprintln!("SKIPPED, nothing was tested: {error}");
            None
        }
    }
}
