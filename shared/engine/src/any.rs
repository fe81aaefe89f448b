//! A backend for a device that is chosen at run time, so that the code that trains is the same for every device.

use cosurf_scene::{Camera, Splats};
use tracing::trace_span;

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

/// Forwards a call to the backend of either variant.
macro_rules! each_backend {
    ($self:ident, $backend:ident => $does:expr) => {
        match $self {
            Self::Cpu($backend) => $does,
            #[cfg(feature = "gpu")]
            Self::Gpu($backend) => $does,
        }
    };
}

/// Forwards a pass to the backend, within a tracing span that has the name of the pass. A graphics card may still be
/// working when the span closes. The rest of its time then counts in the next pass that reads results back.
macro_rules! pass {
    ($self:ident.$pass:ident($($argument:expr),*)) => {{
        let _span = trace_span!(stringify!($pass)).entered();
        each_backend!($self, backend => backend.$pass($($argument),*))
    }};
}

impl AnyBackend {
    /// Allocates every buffer of a backend. Fails if they do not fit on the graphics card. The CPU backend uses
    /// `threads` threads, at least 1.
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
        pass!(self.load(splats));
    }

    fn splats(&self) -> Splats {
        pass!(self.splats())
    }

    fn into_splats(self) -> Splats {
        let _span = trace_span!("splats").entered();
        each_backend!(self, backend => backend.into_splats())
    }

    fn project_up_to(&mut self, camera: &Camera, sh_degree: u32, far: f64) {
        // The pass is called `project` in logs and documents, with a far plane or without.
        let _span = trace_span!("project").entered();
        each_backend!(self, backend => backend.project_up_to(camera, sh_degree, far));
    }

    fn bin(&mut self) {
        pass!(self.bin());
    }

    fn counts(&self) -> BinCounts {
        each_backend!(self, backend => backend.counts())
    }

    fn rasterize(&mut self, channels: Channels) {
        pass!(self.rasterize(channels));
    }

    fn keep_neighbour(&mut self) {
        pass!(self.keep_neighbour());
    }

    fn losses(&mut self, targets: &Targets, weights: &LossWeights) -> Losses {
        pass!(self.losses(targets, weights))
    }

    fn rasterize_backward(&mut self) {
        pass!(self.rasterize_backward());
    }

    fn project_backward(&mut self) {
        pass!(self.project_backward());
    }

    fn gradients(&self) -> Splats {
        each_backend!(self, backend => backend.gradients())
    }

    fn adam(&mut self, rates: &AdamRates) {
        pass!(self.adam(rates));
    }

    fn rendering(&self) -> Rendering {
        pass!(self.rendering())
    }

    fn with_threads<R: Send>(&self, job: impl FnOnce() -> R + Send) -> R {
        each_backend!(self, backend => backend.with_threads(job))
    }

    fn take_shapes(&mut self) -> Shapes {
        pass!(self.take_shapes())
    }

    fn clear_scores(&mut self) {
        each_backend!(self, backend => backend.clear_scores());
    }

    fn score(&mut self) {
        pass!(self.score());
    }

    fn may_score_new_hits(&self, first: usize) -> bool {
        each_backend!(self, backend => backend.may_score_new_hits(first))
    }

    fn scores(&self) -> Scores {
        each_backend!(self, backend => backend.scores())
    }

    fn edit(&mut self, edit: &Edit) {
        pass!(self.edit(edit));
    }

    fn cap_opacity(&mut self, opacity: f32) {
        pass!(self.cap_opacity(opacity));
    }

    fn export<E>(&self, visit: impl FnMut(&[f32]) -> Result<(), E>) -> Result<(), E> {
        each_backend!(self, backend => backend.export(visit))
    }

    fn import<E>(&mut self, len: usize, fill: impl FnMut(&mut [f32]) -> Result<(), E>) -> Result<(), E> {
        each_backend!(self, backend => backend.import(len, fill))
    }
}
