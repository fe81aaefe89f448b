//! The GPU backend, built on wgpu. It computes the same results as the CPU backend within a tolerance, on graphics
//! cards with Vulkan, Metal or DirectX 12.
//!
//! The backend is portable: its passes use no float atomics, at most 8 storage buffers each, and subgroups only where a
//! card has them and they are faster. It needs only the default limits of wgpu, except for the sizes of buffers. Sums have
//! a fixed order, so two runs on one card give the same bits.
//!
//! Reading order: `backend` for the whole; `model`, `draw`, `train` and `surface` for the buffers; `sort` for the radix
//! sort; then the passes in [`cosurf_shaders`].

mod backend;
mod bindings;
mod buffer;
mod checkpoint;
mod context;
mod draw;
mod edit;
mod hush;
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
