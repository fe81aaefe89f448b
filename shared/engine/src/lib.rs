//! The engine for Gaussian surfaces: it rasterises splats, compares the renderings with photographs, and optimises the
//! splats. Two backends, CPU and GPU, compute the same results within a tolerance that the tests check.
//!
//! What it knows nothing about: wire formats, clocks, command lines, and files, except that [`Views`] reads a model that need
//! not fit into the memory.
//!
//! Where to start reading: [`backend`] declares the passes, and in [`train`] a step reads as a list of passes. Then
//! `layout` has the code that both backends share, [`cpu`] uses SIMD and threads, and `gpu` uses graphics cards.

#![cfg_attr(not(test), warn(clippy::disallowed_methods))]

mod align;
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
mod poses;
pub mod prune;
mod random;
mod refine;
pub mod render;
pub mod schedule;
mod simd;
pub mod train;
mod views;

pub use any::AnyBackend;
pub use backend::{Backend, Rendering};
pub use base::base_of;
pub use budget::{Budget, Capacity};
pub use cache::RenderingCache;
pub use compress::{Compression, Observations, Observers, Reach, Trust};
pub use cpu::CpuBackend;
pub use device::{Device, DeviceChoice, DeviceError, DeviceLost};
pub use distill::{DistillSettings, Distiller, Lesson, StudentRates};
pub use neighbours::{Neighbours, typical_depth};
pub use poses::{PoseChoice, PosesFound, aligned};
pub use prune::PruneScore;
pub use render::Renderer;
pub use schedule::Schedule;
pub use train::{Example, Progress, PruneSettings, SurfaceSettings, TrainSettings, Trainer, TrainingViews};
pub use views::{Place, ViewError, ViewMemory, Views};
