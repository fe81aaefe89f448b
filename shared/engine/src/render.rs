//! Rendering a finished model.

use cosurf_scene::{Camera, Splats};

use crate::backend::{Backend, Channels, Rendering};
use crate::cpu::{CpuBackend, CpuCapacity};

/// Splat–tile pairs that rendering makes room for, per splat; a view that needs more makes the renderer grow.
const PAIRS_PER_SPLAT: usize = 4;

/// Renders splats on the CPU.
pub struct Renderer {
    backend: CpuBackend,
    sh_degree: u32,
}

impl Renderer {
    /// Takes a copy of the splats. `threads` is at least 1.
    pub fn new(splats: &Splats, threads: usize) -> Self {
        let capacity = CpuCapacity {
            splats: splats.len(),
            pairs: 0,
            size_px: [1, 1],
            sh_degree: splats.sh_degree,
            channels: Channels::Geometry,
            training: false,
        };
        let mut backend = CpuBackend::new(capacity, threads);
        backend.load(splats);
        backend.set_pair_capacity(PAIRS_PER_SPLAT * splats.len());
        Self { backend, sh_degree: splats.sh_degree }
    }

    /// Colour, alpha, depth and normal as the camera sees them.
    pub fn render(&mut self, camera: &Camera) -> Rendering {
        self.blend(camera, Channels::Geometry);
        self.backend.rendering()
    }

    /// How much the pictures of `cameras` need each splat: Σ (α T)² over all pixels of all of them.
    pub fn importance(&mut self, cameras: &[Camera]) -> Vec<f32> {
        self.backend.clear_scores();
        for camera in cameras {
            self.blend(camera, Channels::Color);
            self.backend.score();
        }
        self.backend.scores().squared_weights
    }

    fn blend(&mut self, camera: &Camera, channels: Channels) {
        self.backend.project(camera, self.sh_degree);
        let counts = self.backend.bin();
        if counts.dropped > 0 {
            self.backend.set_pair_capacity(counts.pairs + counts.dropped);
            self.backend.bin();
        }
        self.backend.rasterize(channels);
    }
}
