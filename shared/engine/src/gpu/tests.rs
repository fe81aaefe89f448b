//! The GPU against the CPU backend, on whatever adapter there is; a software driver will do.
//!
//! Where there is no adapter the tests skip with a visible line; with `REQUIRE_GPU` in the environment they fail.

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
