//! The wgpu backend: the same numbers as the CPU's on any graphics card with Vulkan, Metal or DirectX 12.
//!
//! Portable by construction: no subgroups, no float atomics, at most 8 storage buffers for a pass (wgpu's default
//! limits, but for the sizes of buffers). Sums are made in a fixed order, so two runs on one card give the same
//! bits. Reading order: `backend` for the whole, `model`, `draw`, `train` and `surface` for what is kept where, `shaders`
//! for the passes, `sort` for the one part that is an algorithm of its own, then the passes in the folder `shaders`
//! beside the crates.

mod backend;
mod buffer;
mod checkpoint;
mod context;
mod draw;
mod edit;
mod layout;
mod model;
mod pass;
mod render;
mod shaders;
mod sort;
mod surface;
#[cfg(test)]
mod tests;
mod train;

pub use backend::{GpuBackend, GpuCapacity};
pub use context::{AdapterSummary, Gpu, GpuChoice, GpuError, adapters};
pub use render::GpuRenderer;
