//! The Gaussian-surface engine: rasterises, compares with photographs, optimises. Two backends, CPU and GPU, compute
//! the same results within a tolerance that tests state.
//!
//! It does not deal with wire formats, clocks, files or command lines.
//!
//! Where to start reading: [`backend`] for the passes, then [`train`], where a step reads as a list of passes; `layout`
//! for code that both backends share, [`cpu`] for SIMD and threads, `gpu` for graphics cards.

mod any;
pub mod backend;
mod base;
pub mod budget;
mod cache;
pub mod compress;
pub mod cpu;
mod device;
pub mod distill;
mod exposure;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod init;
mod layout;
pub mod nearest;
pub mod neighbours;
mod plane;
pub mod prune;
mod random;
mod refine;
pub mod render;
pub mod schedule;
mod simd;
pub mod train;

pub use any::AnyBackend;
pub use backend::{Backend, Rendering};
pub use base::base_of;
pub use budget::{Budget, Capacity};
pub use cache::RenderingCache;
pub use compress::{Compression, ModelCameras};
pub use cpu::CpuBackend;
pub use device::{Device, DeviceChoice, DeviceError, DeviceLost};
pub use distill::{DistillSettings, Distiller, Lesson, StudentRates};
pub use neighbours::Neighbours;
pub use prune::PruneScore;
pub use render::Renderer;
pub use schedule::Schedule;
pub use train::{Example, Progress, PruneSettings, SurfaceSettings, TrainSettings, Trainer, TrainingViews};
