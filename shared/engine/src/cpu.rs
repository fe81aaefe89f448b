//! The CPU backend, with SIMD and threads. Its results have the same bits for any number of threads.
//!
//! Each thread writes only its own memory (blocks of splats, tiles, bands of lines). Sums across threads are computed
//! afterwards in a fixed order. Reading order: `blocks` for the layout, `backend` for the whole, then the passes as a
//! step calls them: `project`, `bin`, `rasterize`, `loss`, `surface`, `rasterize_backward`, `project_backward`, `adam`.

mod adam;
mod backend;
mod bin;
mod blocks;
mod geometry;
mod loss;
mod model;
mod project;
mod project_backward;
mod rasterize;
mod rasterize_backward;
mod read;
mod records;
mod score;
mod scratch;
mod surface;
#[cfg(test)]
pub(crate) mod tests;

pub use backend::CpuBackend;
