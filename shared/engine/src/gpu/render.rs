//! Renders a finished model on the GPU.

use cosurf_scene::{Camera, Splats};

use super::context::{Gpu, GpuError};
use super::draw::Drawing;
use super::model::Model;
use crate::backend::{Channels, Rendering};
use crate::budget::PAIRS_PER_SPLAT;

/// Splats on the GPU, to be rendered.
#[derive(Debug)]
pub struct GpuRenderer {
    gpu: Gpu,
    model: Model,
    drawing: Drawing,
}

impl GpuRenderer {
    /// Copies the splats to the GPU.
    pub fn new(gpu: &Gpu, splats: &Splats) -> Result<Self, GpuError> {
        let gpu = gpu.for_model();
        let (mut model, drawing) = gpu.allocating(|| {
            let model = Model::new(&gpu, splats.len(), splats.sh_degree)?;
            Ok((model, Drawing::new(&gpu, splats.len(), PAIRS_PER_SPLAT * splats.len(), [1, 1])?))
        })?;
        model.load(&gpu, splats);
        Ok(Self { gpu, model, drawing })
    }

    /// Name of the device for people.
    pub fn device(&self) -> String {
        self.gpu.to_string()
    }

    /// The splats.
    pub fn splats(&self) -> Splats {
        self.model.splats(&self.gpu)
    }

    /// Renders colour, alpha, depth and normal of the splats up to the depth `far`, world units. Grows the buffers if
    /// necessary.
    pub fn render(&mut self, camera: &Camera, far: f64) -> Result<Rendering, GpuError> {
        let Self { gpu, model, drawing } = self;
        gpu.allocating(|| drawing.grow_picture(gpu, camera.size_px))?;
        drawing.project(gpu, model, camera, model.sh_degree, far);
        drawing.bin(gpu, model);
        let counts = drawing.counts(gpu);
        if counts.dropped > 0 {
            gpu.allocating(|| drawing.grow_pairs(gpu, counts.pairs + counts.dropped))?;
            drawing.project(gpu, model, camera, model.sh_degree, far);
            drawing.bin(gpu, model);
        }
        drawing.rasterize(gpu, model, Channels::Geometry);
        let rendering = drawing.rendering(gpu);
        gpu.lost().map_or(Ok(rendering), |reason| Err(GpuError::Lost(reason)))
    }
}
