//! The backend of the chosen device, so that trainings do not depend on the device.

use cosurf_scene::{Camera, Splats};

use crate::backend::{
    AdamRates, Backend, BinCounts, Channels, Edit, LossWeights, Losses, Rendering, Scores, Shapes, Targets,
};
use crate::budget::Capacity;
use crate::cpu::CpuBackend;
use crate::device::{Device, DeviceError};
#[cfg(feature = "gpu")]
use crate::gpu::GpuBackend;

/// A CPU or a GPU backend.
pub enum AnyBackend {
    /// The processor.
    Cpu(Box<CpuBackend>),
    /// A graphics card.
    #[cfg(feature = "gpu")]
    Gpu(Box<GpuBackend>),
}

/// Forwards a call to the backend that there is.
macro_rules! each_backend {
    ($self:ident, $backend:ident => $does:expr) => {
        match $self {
            Self::Cpu($backend) => $does,
            #[cfg(feature = "gpu")]
            Self::Gpu($backend) => $does,
        }
    };
}

impl AnyBackend {
    /// Allocates every buffer; the CPU backend uses `threads` threads, at least 1.
    pub fn new(device: &Device, capacity: Capacity, threads: usize) -> Result<Self, DeviceError> {
        match device {
            Device::Cpu => Ok(Self::Cpu(Box::new(CpuBackend::new(capacity, threads)))),
            #[cfg(feature = "gpu")]
            Device::Gpu(gpu) => Ok(Self::Gpu(Box::new(GpuBackend::new(gpu, capacity)?))),
        }
    }
}

impl Backend for AnyBackend {
    fn device(&self) -> String {
        each_backend!(self, backend => backend.device())
    }

    fn lost(&self) -> Option<String> {
        each_backend!(self, backend => backend.lost())
    }

    fn len(&self) -> usize {
        each_backend!(self, backend => backend.len())
    }

    fn capacity(&self) -> usize {
        each_backend!(self, backend => backend.capacity())
    }

    fn load(&mut self, splats: &Splats) {
        each_backend!(self, backend => backend.load(splats));
    }

    fn splats(&self) -> Splats {
        each_backend!(self, backend => backend.splats())
    }

    fn project(&mut self, camera: &Camera, sh_degree: u32) {
        each_backend!(self, backend => backend.project(camera, sh_degree));
    }

    fn bin(&mut self) -> BinCounts {
        each_backend!(self, backend => backend.bin())
    }

    fn rasterize(&mut self, channels: Channels) {
        each_backend!(self, backend => backend.rasterize(channels));
    }

    fn keep_neighbour(&mut self) {
        each_backend!(self, backend => backend.keep_neighbour());
    }

    fn losses(&mut self, targets: &Targets, weights: &LossWeights) -> Losses {
        each_backend!(self, backend => backend.losses(targets, weights))
    }

    fn rasterize_backward(&mut self) {
        each_backend!(self, backend => backend.rasterize_backward());
    }

    fn project_backward(&mut self) {
        each_backend!(self, backend => backend.project_backward());
    }

    fn gradients(&self) -> Splats {
        each_backend!(self, backend => backend.gradients())
    }

    fn adam(&mut self, rates: &AdamRates) {
        each_backend!(self, backend => backend.adam(rates));
    }

    fn rendering(&self) -> Rendering {
        each_backend!(self, backend => backend.rendering())
    }

    fn take_shapes(&mut self) -> Shapes {
        each_backend!(self, backend => backend.take_shapes())
    }

    fn clear_scores(&mut self) {
        each_backend!(self, backend => backend.clear_scores());
    }

    fn score(&mut self) {
        each_backend!(self, backend => backend.score());
    }

    fn scores(&self) -> Scores {
        each_backend!(self, backend => backend.scores())
    }

    fn edit(&mut self, edit: &Edit) {
        each_backend!(self, backend => backend.edit(edit));
    }

    fn cap_opacity(&mut self, opacity: f32) {
        each_backend!(self, backend => backend.cap_opacity(opacity));
    }

    fn export<E>(&self, visit: impl FnMut(&[f32]) -> Result<(), E>) -> Result<(), E> {
        each_backend!(self, backend => backend.export(visit))
    }

    fn import<E>(&mut self, len: usize, fill: impl FnMut(&mut [f32]) -> Result<(), E>) -> Result<(), E> {
        each_backend!(self, backend => backend.import(len, fill))
    }
}
