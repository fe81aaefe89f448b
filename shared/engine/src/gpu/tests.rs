//! Compares the GPU backend with the CPU backend, on any adapter, including software drivers.
//!
//! Without an adapter, the tests print a line and are skipped. If the environment variable `REQUIRE_GPU` is set, they
//! fail instead.

mod adapter;
mod compare;
mod constants;
mod forward;
mod gradients;
mod limits;
mod scores;
mod shaders;
mod sort;
mod state;
mod surface;
mod train;
