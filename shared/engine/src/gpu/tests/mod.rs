//! The GPU against the CPU backend, on whatever adapter there is; a software driver will do.
//!
//! Where there is no adapter the tests skip with a visible line; with `REQUIRE_GPU` in the environment they fail.

mod compare;
mod forward;
mod gradients;
mod limits;
mod scores;
mod shaders;
mod sort;
mod state;
mod surface;
mod train;

use super::context::{Gpu, GpuChoice};

/// The adapter that the tests use, or `None` after saying so.
fn gpu() -> Option<Gpu> {
    match Gpu::open(GpuChoice::Any) {
        Ok(gpu) => Some(gpu),
        Err(error) => {
            assert!(std::env::var_os("REQUIRE_GPU").is_none(), "REQUIRE_GPU is set, but {error}");
            eprintln!("SKIPPED, nothing was tested: {error}");
            None
        }
    }
}
