//! The GPU as a [`Backend`].
//!
//! All passes of a step run on the GPU. A step uploads its inputs, such as the photograph, and reads back only counts and
//! sums of losses, all at once, because the card idles while the processor waits for it. Only rarer operations, such as
//! refinements and checkpoints, read and write the numbers of the splats.

use cosurf_scene::{Camera, Splats};
use rayon::prelude::*;

use super::buffer::{Buffer, read_together, read_with};
use super::context::{Gpu, GpuError};
use super::draw::{Drawing, counts};
use super::edit::Editor;
use super::model::Model;
use super::structs::{COUNTERS, Projected, Rates};
use super::surface::{Summed, Surface};
use super::train::{Training, loss};
use super::{checkpoint, edit};
use crate::backend::{
    AdamRates, Backend, BinCounts, Channels, Edit, LossWeights, Losses, Rendering, Scores, Shapes, Targets,
};
use crate::budget::{Capacity, PROJECTED_BYTES};
use crate::layout::harmonics;
use crate::layout::rows::{
    GRADIENT_RGB, GRADIENT_ROWS, LOG_SCALE, MEAN, OPACITY, QUAT, SCORE_ROWS, SH, STAT_ABSOLUTE_GRADIENT,
    STAT_ROWS, STAT_SCREEN_GRADIENT, STAT_VIEWS,
};

const _: () = assert!(size_of::<Projected>() == PROJECTED_BYTES, "the budget counts a projected splat right");

/// Splats on the GPU, to be trained.
#[derive(Debug)]
pub struct GpuBackend {
    gpu: Gpu,
    model: Model,
    drawing: Drawing,
    training: Training,
    /// The surface losses; `None` if the capacity has [`Channels::Color`].
    surface: Option<Surface>,
    editor: Editor,
    /// Counts of the last binning pass, once they are read.
    counts: Option<BinCounts>,
    /// Weight of the shortest scale of each visible splat in the next backward pass.
    scale_weight: f32,
}

impl GpuBackend {
    /// Allocates every buffer, including those of training, even if `capacity` is for rendering only.
    pub fn new(gpu: &Gpu, capacity: Capacity) -> Result<Self, GpuError> {
        let Capacity { splats, pairs, size_px, sh_degree, channels, .. } = capacity;
        assert!(sh_degree <= 3, "SH degree {sh_degree}");
        let (model, drawing, training, surface) = gpu.allocating(|| {
            let model = Model::new(gpu, splats, sh_degree)?;
            let training = Training::new(gpu, &model, pairs, size_px)?;
            let surface = match channels {
                Channels::Color => None,
                Channels::Geometry => Some(Surface::new(gpu, size_px)?),
            };
            Ok((model, Drawing::new(gpu, splats, pairs, size_px)?, training, surface))
        })?;
        let editor = Editor::new(gpu);
        let gpu = gpu.for_model();
        let backend =
            Self { gpu, model, drawing, training, surface, editor, counts: None, scale_weight: 0.0 };
        backend.training.reset(&backend.gpu);
        Ok(backend)
    }

    /// One row of a buffer, for all splats.
    fn row(&self, buffer: &Buffer<f32>, row: usize) -> Vec<f32> {
        buffer.read(&self.gpu, row * self.model.stride..row * self.model.stride + self.model.len)
    }

    fn rows<const N: usize>(&self, buffer: &Buffer<f32>) -> [Vec<f32>; N] {
        std::array::from_fn(|row| self.row(buffer, row))
    }
}

/// The shapes and mean statistics of `len` splats, from the rows of a model and of its statistics.
fn shapes_of([shape, stats]: [&[f32]; 2], len: usize, stride: usize) -> Shapes {
    let each = || (0..len).into_par_iter();
    let shape = |row: usize, i: usize| shape[row * stride + i];
    let views = &stats[STAT_VIEWS * stride..][..len];
    let mean = |row: usize| each().map(|i| stats[row * stride + i] / views[i].max(1.0)).collect();
    Shapes {
        means: each().map(|i| [0, 1, 2].map(|k| shape(MEAN + k, i))).collect(),
        quats: each().map(|i| [0, 1, 2, 3].map(|k| shape(QUAT + k, i))).collect(),
        log_scales: each().map(|i| [0, 1, 2].map(|k| shape(LOG_SCALE + k, i))).collect(),
        opacity_logits: each().map(|i| shape(OPACITY, i)).collect(),
        screen_gradients: mean(STAT_SCREEN_GRADIENT),
        absolute_gradients: mean(STAT_ABSOLUTE_GRADIENT),
        views: views.to_vec(),
    }
}

impl Backend for GpuBackend {
    fn device(&self) -> String {
        self.gpu.to_string()
    }

    fn lost(&self) -> Option<String> {
        self.gpu.lost()
    }

    fn len(&self) -> usize {
        self.model.len
    }

    fn capacity(&self) -> usize {
        self.model.stride
    }

    fn load(&mut self, splats: &Splats) {
        assert!(splats.len() <= self.model.stride, "{} splats of {}", splats.len(), self.model.stride);
        self.model.load(&self.gpu, splats);
        self.training.reset(&self.gpu);
    }

    fn splats(&self) -> Splats {
        self.model.splats(&self.gpu)
    }

    fn project_up_to(&mut self, camera: &Camera, sh_degree: u32, far: f64) {
        self.drawing.project(&self.gpu, &self.model, camera, sh_degree, far);
    }

    fn bin(&mut self) {
        self.drawing.bin(&self.gpu, &self.model);
        self.counts = None;
    }

    fn counts(&self) -> BinCounts {
        self.counts.unwrap_or_else(|| self.drawing.counts(&self.gpu))
    }

    fn rasterize(&mut self, channels: Channels) {
        self.drawing.rasterize(&self.gpu, &self.model, channels);
    }

    fn keep_neighbour(&mut self) {
        let surface = self.surface.as_mut().expect("room for the surface");
        surface.keep_neighbour(&self.gpu, &self.drawing);
    }

    fn losses(&mut self, targets: &Targets, weights: &LossWeights) -> Losses {
        let Self { gpu, drawing, training, .. } = self;
        let Targets { rgb, exposure, .. } = *targets;
        training.photometric(gpu, drawing, rgb, exposure, weights.ssim);
        let (summed, sums) = match &self.surface {
            Some(surface) => {
                let summed = surface.losses(gpu, drawing, training, targets, weights);
                (summed, surface.sums.part(0..summed.len()))
            }
            None => (Summed::default(), training.totals.part(0..0)),
        };
        let parts = [training.totals.part(0..1), sums, drawing.counters.part(0..COUNTERS)];
        let [totals, sums, counters] = read_together(gpu, parts);
        let counts = counts(&bytemuck::pod_collect_to_vec(&counters));
        self.counts = Some(counts);
        self.scale_weight = weights.scale / counts.visible.max(1) as f32;
        let color = loss(bytemuck::pod_read_unaligned(&totals), drawing.seen_view().size_px, weights.ssim);
        let (surface, teacher) = summed.losses(&bytemuck::pod_collect_to_vec(&sums));
        Losses { color, surface, teacher }
    }

    fn rasterize_backward(&mut self) {
        self.training.rasterize_backward(&self.gpu, &self.drawing);
    }

    fn project_backward(&mut self) {
        self.training.project_backward(&self.gpu, &self.model, &self.drawing, self.scale_weight);
    }

    fn gradients(&self) -> Splats {
        let rows: [Vec<f32>; GRADIENT_ROWS] = self.rows(&self.training.gradients);
        let mean: [Vec<f32>; 3] = self.rows(&self.model.shape);
        let (view, sh_degree) = (self.drawing.seen_view(), self.model.sh_degree);
        let mut out = Splats::with_capacity(self.model.len, sh_degree);
        for i in 0..self.model.len {
            let v_rgb = [0, 1, 2].map(|channel| rows[GRADIENT_RGB + channel][i]);
            let sh = harmonics::sh_gradients([0, 1, 2].map(|axis| mean[axis][i]), v_rgb, view, sh_degree);
            out.push(
                [0, 1, 2].map(|k| rows[MEAN + k][i]),
                [0, 1, 2, 3].map(|k| rows[QUAT + k][i]),
                [0, 1, 2].map(|k| rows[LOG_SCALE + k][i]),
                rows[OPACITY][i],
                &sh,
            );
        }
        out
    }

    fn adam(&mut self, rates: &AdamRates) {
        self.training.adam(&self.gpu, &self.model, &self.drawing, Rates::from(rates));
    }

    fn rendering(&self) -> Rendering {
        self.drawing.rendering(&self.gpu)
    }

    fn take_shapes(&mut self) -> Shapes {
        let Model { len, stride, .. } = self.model;
        if len == 0 {
            return Shapes::default();
        }
        let rows = |count: usize| 0..(count - 1) * stride + len;
        let parts = [self.model.shape.part(rows(SH)), self.training.stats.part(rows(STAT_ROWS))];
        let shapes =
            read_with(&self.gpu, parts, |parts| shapes_of(parts.map(bytemuck::cast_slice), len, stride));
        self.training.stats.clear(&self.gpu);
        shapes
    }

    fn clear_scores(&mut self) {
        self.training.scores.clear(&self.gpu);
    }

    fn score(&mut self) {
        self.training.score(&self.gpu, &self.model, &self.drawing);
    }

    fn scores(&self) -> Scores {
        let [squared_weights, hits, observers]: [Vec<f32>; SCORE_ROWS] = self.rows(&self.training.scores);
        Scores { squared_weights, hits, observers }
    }

    fn edit(&mut self, edit: &Edit) {
        self.editor.apply(&self.gpu, &mut self.model, &self.training, edit);
    }

    fn cap_opacity(&mut self, opacity: f32) {
        edit::cap_opacity(&self.gpu, &self.model, &self.training, opacity);
    }

    fn export<E>(&self, visit: impl FnMut(&[f32]) -> Result<(), E>) -> Result<(), E> {
        checkpoint::export(&self.gpu, &self.model, &self.training, visit)
    }

    fn import<E>(&mut self, len: usize, fill: impl FnMut(&mut [f32]) -> Result<(), E>) -> Result<(), E> {
        checkpoint::import(&self.gpu, &mut self.model, &self.training, len, fill)
    }
}
