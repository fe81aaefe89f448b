//! Renders a finished model.

use cosurf_scene::{Camera, Splats};

use crate::backend::{Backend, Channels, Rendering};
use crate::budget::{Capacity, PAIRS_PER_SPLAT};
use crate::cpu::CpuBackend;
use crate::device::{Device, DeviceChoice, DeviceError};
#[cfg(feature = "gpu")]
use crate::gpu::{GpuError, GpuRenderer};

/// Renders splats.
pub struct Renderer {
    painter: Painter,
}

/// The backend that renders.
enum Painter {
    Cpu(Box<CpuPainter>),
    /// The number is that of CPU threads, for when the splats move to the processor.
    #[cfg(feature = "gpu")]
    Gpu(Box<GpuRenderer>, usize),
}

/// What a picture shows of a model.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Seen {
    /// Indices of the splats, ascending. All others can be left out without changing a bit of the picture.
    pub(crate) splats: Vec<u32>,
    /// Number of splat–tile pairs, which decides how much memory [`Renderer::render`] takes.
    pub(crate) pairs: usize,
}

struct CpuPainter {
    backend: CpuBackend,
    sh_degree: u32,
}

impl Renderer {
    /// Copies the splats, to render them on the processor with `threads` threads, at least 1.
    pub fn new(splats: &Splats, threads: usize) -> Self {
        Self { painter: Painter::Cpu(Box::new(CpuPainter::new(splats, threads))) }
    }

    /// Opens the chosen device and copies the splats to it; the processor uses `threads` threads, at least 1.
    pub fn on(choice: DeviceChoice, threads: usize, splats: &Splats) -> Result<Self, DeviceError> {
        Self::by(&choice.open()?, threads, splats)
    }

    /// Copies the splats to an open device; the processor uses `threads` threads, at least 1.
    pub fn by(device: &Device, threads: usize, splats: &Splats) -> Result<Self, DeviceError> {
        match device {
            Device::Cpu => Ok(Self::new(splats, threads)),
            #[cfg(feature = "gpu")]
            Device::Gpu(gpu) => {
                Ok(Self { painter: Painter::Gpu(Box::new(GpuRenderer::new(gpu, splats)?), threads) })
            }
        }
    }

    /// Number of splats.
    #[cfg(test)]
    pub(crate) fn splats(&self) -> usize {
        match &self.painter {
            Painter::Cpu(painter) => painter.backend.len(),
            #[cfg(feature = "gpu")]
            Painter::Gpu(painter, _) => painter.splats().len(),
        }
    }

    /// Name of the device for people.
    pub fn device(&self) -> String {
        match &self.painter {
            Painter::Cpu(painter) => painter.backend.device(),
            #[cfg(feature = "gpu")]
            Painter::Gpu(painter, _) => painter.device(),
        }
    }

    /// Renders colour, alpha, depth and normal. If a picture does not fit on the GPU, this and all later pictures are
    /// rendered on the processor. Panics if the GPU is lost, because the splats are lost with it.
    pub fn render(&mut self, camera: &Camera) -> Rendering {
        self.try_render(camera).unwrap_or_else(|lost| panic!("{lost}"))
    }

    /// As [`Self::render`], but colours only, `[h, w, rgb]`; on the processor this takes less time.
    pub fn render_colors(&mut self, camera: &Camera) -> Vec<f32> {
        match &mut self.painter {
            Painter::Cpu(painter) => painter.render(camera, f64::INFINITY, Channels::Color).rgb,
            #[cfg(feature = "gpu")]
            Painter::Gpu(..) => self.render(camera).rgb,
        }
    }

    /// As [`Self::render`], but returns an error if the GPU is lost.
    pub fn try_render(&mut self, camera: &Camera) -> Result<Rendering, DeviceError> {
        self.try_render_up_to(camera, f64::INFINITY)
    }

    /// As [`Self::try_render`], but without splats whose centres lie deeper than `far`. `far` is a depth along the optical
    /// axis, world units.
    pub fn try_render_up_to(&mut self, camera: &Camera, far: f64) -> Result<Rendering, DeviceError> {
        #[cfg(feature = "gpu")]
        if let Painter::Gpu(painter, _) = &mut self.painter {
            match painter.render(camera, far) {
                Ok(rendering) => return Ok(rendering),
                Err(lost @ GpuError::Lost(_)) => return Err(lost.into()),
                Err(_) => {}
            }
        }
        Ok(self.on_cpu().render(camera, far, Channels::Geometry))
    }

    /// As [`Self::try_render`], but `None` instead of a picture with more than `pairs_max` pairs of splat and tile, which takes
    /// too much memory on the processor.
    pub(crate) fn try_render_within(
        &mut self,
        camera: &Camera,
        pairs_max: usize,
    ) -> Result<Option<Rendering>, DeviceError> {
        match &mut self.painter {
            Painter::Cpu(painter) => Ok(painter
                .blend(camera, f64::INFINITY, Channels::Geometry, pairs_max)
                .then(|| painter.backend.rendering())),
            #[cfg(feature = "gpu")]
            Painter::Gpu(..) => self.try_render(camera).map(Some),
        }
    }

    /// Importance of each splat to the pictures of `cameras`: Σ (α T)² over all their pixels, with α the splat's alpha
    /// at a pixel and T the transmittance in front of it. The splats move to the processor, which also renders all
    /// later pictures.
    pub fn importance(&mut self, cameras: &[Camera]) -> Vec<f32> {
        let painter = self.on_cpu();
        painter.begin_importance();
        cameras.iter().for_each(|camera| painter.add_importance(camera));
        painter.importance()
    }

    /// The same, unless `is_stopped` before one of the cameras.
    pub fn importance_unless(
        &mut self,
        cameras: &[Camera],
        is_stopped: &dyn Fn() -> bool,
    ) -> Option<Vec<f32>> {
        let painter = self.on_cpu();
        painter.begin_importance();
        for camera in cameras {
            if is_stopped() {
                return None;
            }
            painter.add_importance(camera);
        }
        Some(painter.importance())
    }

    /// What a picture would show, without blending it. The splats move to the processor, which also renders all later
    /// pictures.
    pub(crate) fn seen(&mut self, camera: &Camera) -> Seen {
        let painter = self.on_cpu();
        let pairs = painter.pairs(camera);
        Seen { splats: painter.backend.visible().map(|splat| splat as u32).collect(), pairs }
    }

    /// Makes room for this many splat–tile pairs on the processor. The splats move to it, and it renders all later
    /// pictures.
    pub(crate) fn reserve_pairs(&mut self, pairs: usize) {
        self.on_cpu().backend.reserve_pairs(pairs);
    }

    /// The renderer on the processor. Splats on the GPU are first moved to it.
    fn on_cpu(&mut self) -> &mut CpuPainter {
        #[cfg(feature = "gpu")]
        if let Painter::Gpu(painter, threads) = &self.painter {
            *self = Self::new(&painter.splats(), *threads);
        }
        match &mut self.painter {
            Painter::Cpu(painter) => painter,
            #[cfg(feature = "gpu")]
            Painter::Gpu(..) => unreachable!("the splats have just moved to the processor"),
        }
    }
}

impl CpuPainter {
    fn new(splats: &Splats, threads: usize) -> Self {
        let capacity = Capacity { splats: splats.len(), ..Capacity::to_render(splats.sh_degree) };
        let mut backend = CpuBackend::new(capacity, threads);
        backend.load(splats);
        backend.set_pair_capacity(PAIRS_PER_SPLAT * splats.len());
        Self { backend, sh_degree: splats.sh_degree }
    }

    fn render(&mut self, camera: &Camera, far: f64, channels: Channels) -> Rendering {
        self.blend(camera, far, channels, usize::MAX);
        self.backend.rendering()
    }

    /// Counts the pairs without making lists of them.
    fn pairs(&mut self, camera: &Camera) -> usize {
        self.backend.project(camera, 0);
        self.backend.set_pair_capacity(0);
        self.backend.bin();
        let counts = self.backend.counts();
        counts.pairs + counts.dropped
    }

    fn begin_importance(&mut self) {
        self.backend.clear_scores();
    }

    fn add_importance(&mut self, camera: &Camera) {
        self.blend(camera, f64::INFINITY, Channels::Color, usize::MAX);
        self.backend.score();
    }

    fn importance(&mut self) -> Vec<f32> {
        self.backend.scores().squared_weights
    }

    /// Returns whether the picture has at most `pairs_max` pairs; else it is not blended.
    fn blend(&mut self, camera: &Camera, far: f64, channels: Channels, pairs_max: usize) -> bool {
        self.backend.project_up_to(camera, self.sh_degree, far);
        self.backend.bin();
        let counts = self.backend.counts();
        let pairs = counts.pairs + counts.dropped;
        if pairs > pairs_max {
            return false;
        }
        if counts.dropped > 0 {
            self.backend.set_pair_capacity(pairs);
            self.backend.bin();
        }
        self.backend.rasterize(channels);
        true
    }
}
