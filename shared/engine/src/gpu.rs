//! The wgpu backend: the same numbers as the CPU's on any graphics card with Vulkan, Metal or DirectX 12.
//!
//! Portable by construction: no subgroups, no float atomics, at most 8 storage buffers for a pass (wgpu's default
//! limits, but for the sizes of buffers). Sums are made in a fixed order, so two runs on one card give the same
//! bits. Reading order: `backend` for the whole, `model`, `draw`, `train` and `surface` for what is kept where, `sort`
//! for the one part that is an algorithm of its own, then the passes themselves in [`cosurf_shaders`].

mod backend;
mod buffer;
mod checkpoint;
mod context;
mod draw;
mod edit;
mod model;
mod pass;
mod recorder;
mod render;
mod sort;
mod structs;
mod surface;
#[cfg(test)]
mod tests;
#[cfg(feature = "gpu-timestamps")]
mod timestamps;
mod train;

pub use backend::GpuBackend;
pub use context::{AdapterSummary, Gpu, GpuChoice, GpuError, adapters};
pub use render::GpuRenderer;
#[cfg(feature = "gpu-timestamps")]
pub use timestamps::PassTime;
