//! The GPU as a [`Backend`]: a training runs on it as it does on the CPU.
//!
//! Every step stays on the GPU: the photograph goes over, what comes back are counts and sums. Refinement and
//! checkpoints, every hundred steps or so, read and write rows of splats.

use cosurf_scene::{Camera, Splats};

use super::buffer::Buffer;
use super::context::{Gpu, GpuError};
use super::draw::Drawing;
use super::layout::{Projected, Rates};
use super::model::{Model, SHAPE_ROWS, sh_rows};
use super::pass::Recorder;
use super::surface::Surface;
use super::train::{GRADIENT_ROWS, PARTIALS, Record, SCORE_ROWS, STAT_ROWS, Training};
use crate::backend::{
    AdamRates, Backend, BinCounts, Channels, Edit, LossWeights, Losses, Rendering, Scores, Shapes, Targets,
};
use crate::cpu::CpuCapacity;
use crate::cpu::image::padded_pixels;
use crate::cpu::rasterize::PLANES_GEOMETRY;
use crate::cpu::read;

/// Everything that has a size, decided before anything is allocated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GpuCapacity {
    /// Most splats.
    pub splats: usize,
    /// Most splat–tile pairs of one view.
    pub pairs: usize,
    /// Largest picture.
    pub size_px: [u32; 2],
    /// Stored SH degree, 0..=3.
    pub sh_degree: u32,
    /// Channels that will be asked for in training.
    pub channels: Channels,
}

impl GpuCapacity {
    /// Bytes of a splat–tile pair: keys and values twice, its splat, its share of the sort's counts; its record.
    pub const fn pair_bytes(training: bool) -> usize {
        16 + 4 + 1 + if training { size_of::<Record>() } else { 0 }
    }

    /// Bytes of a splat in all buffers whose length is the number of splats.
    pub const fn splat_bytes(sh_degree: u32, training: bool) -> usize {
        let parameters = 4 * (SHAPE_ROWS + sh_rows(sh_degree));
        // Depth, place and slots 16, keys and values to sort twice 16.
        let drawn = size_of::<Projected>() + 16 + 16;
        if training {
            3 * parameters + 4 * (GRADIENT_ROWS + STAT_ROWS + SCORE_ROWS) + drawn
        } else {
            parameters + drawn
        }
    }

    /// Bytes of a pair in the largest buffer of pairs: its record.
    pub const PAIR_BINDING_BYTES: usize = size_of::<Record>();

    /// Bytes of a splat in the largest buffer of splats.
    pub fn splat_binding_bytes(sh_degree: u32) -> usize {
        (4 * GRADIENT_ROWS.max(sh_rows(sh_degree))).max(size_of::<Projected>())
    }

    /// Bytes of the largest buffer of pictures.
    pub fn picture_binding_bytes(size_px: [u32; 2]) -> usize {
        padded_pixels(size_px) * 4 * PARTIALS.max(PLANES_GEOMETRY)
    }

    /// Bytes of the pictures: rendered, its gradient, the photograph, SSIM's derivatives; with geometry what the losses
    /// of the surface keep.
    pub fn picture_bytes(size_px: [u32; 2], channels: Channels) -> usize {
        let surface = match channels {
            Channels::Color => 0,
            Channels::Geometry => Surface::PIXEL_BYTES,
        };
        padded_pixels(size_px) * (4 * (2 * PLANES_GEOMETRY + 3 + PARTIALS) + 1 + surface)
    }
}

impl From<CpuCapacity> for GpuCapacity {
    /// Room for the same.
    fn from(capacity: CpuCapacity) -> Self {
        let CpuCapacity { splats, pairs, size_px, sh_degree, channels, training: _ } = capacity;
        Self { splats, pairs, size_px, sh_degree, channels }
    }
}

/// Splats on the GPU, to be trained.
#[derive(Debug)]
pub struct GpuBackend {
    pub(super) gpu: Gpu,
    pub(super) model: Model,
    pub(super) drawing: Drawing,
    pub(super) training: Training,
    /// There with [`Channels::Geometry`].
    surface: Option<Surface>,
    visible: usize,
    /// Weight of the scale loss in the backward pass that comes.
    scale_weight: f32,
}

impl GpuBackend {
    /// Allocates every buffer.
    pub fn new(gpu: &Gpu, capacity: GpuCapacity) -> Result<Self, GpuError> {
        let GpuCapacity { splats, pairs, size_px, sh_degree, channels } = capacity;
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
        let backend =
            Self { gpu: gpu.clone(), model, drawing, training, surface, visible: 0, scale_weight: 0.0 };
        backend.training.reset(gpu);
        Ok(backend)
    }

    pub(super) fn clear(&self, buffer: &Buffer<f32>) {
        let mut r = Recorder::new(&self.gpu);
        r.clear(&buffer.raw);
        r.submit();
    }

    /// One row of a buffer, for all splats.
    fn row(&self, buffer: &Buffer<f32>, row: usize) -> Vec<f32> {
        buffer.read(&self.gpu, row * self.model.stride..row * self.model.stride + self.model.len)
    }

    fn rows<const N: usize>(&self, buffer: &Buffer<f32>) -> [Vec<f32>; N] {
        std::array::from_fn(|row| self.row(buffer, row))
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

    fn project(&mut self, camera: &Camera, sh_degree: u32) {
        self.drawing.project(&self.gpu, &self.model, camera, sh_degree);
    }

    fn bin(&mut self) -> BinCounts {
        let counts = self.drawing.bin(&self.gpu, &self.model);
        self.visible = counts.visible;
        counts
    }

    fn rasterize(&mut self, channels: Channels) {
        self.drawing.rasterize(&self.gpu, &self.model, channels);
    }

    fn keep_neighbour(&mut self) {
        let surface = self.surface.as_mut().expect("room for the surface");
        surface.keep_neighbour(&self.gpu, &self.drawing);
    }

    fn losses(&mut self, targets: &Targets, weights: &LossWeights) -> Losses {
        self.scale_weight = weights.scale;
        let Targets { rgb, exposure, .. } = *targets;
        let color = self.training.photometric(&self.gpu, &self.drawing, rgb, exposure, weights.ssim);
        let (surface, teacher) = match &self.surface {
            Some(surface) => surface.losses(&self.gpu, &self.drawing, &self.training, targets, weights),
            None => Default::default(),
        };
        Losses { color, surface, teacher }
    }

    fn rasterize_backward(&mut self) {
        self.training.rasterize_backward(&self.gpu, &self.drawing);
    }

    fn project_backward(&mut self) {
        let scale_weight = self.scale_weight / self.visible.max(1) as f32;
        self.training.project_backward(&self.gpu, &self.model, &self.drawing, scale_weight);
    }

    fn gradients(&self) -> Splats {
        let shape: [Vec<f32>; SHAPE_ROWS + 3] = self.rows(&self.training.gradients);
        let mean: [Vec<f32>; 3] = self.rows(&self.model.shape);
        let (view, sh_degree) = (self.drawing.seen_view(), self.model.sh_degree);
        let mut out = Splats::with_capacity(self.model.len, sh_degree);
        for i in 0..self.model.len {
            let v_rgb = [0, 1, 2].map(|channel| shape[SHAPE_ROWS + channel][i]);
            let sh = read::sh_gradients([0, 1, 2].map(|axis| mean[axis][i]), v_rgb, view, sh_degree);
            out.push(
                [0, 1, 2].map(|r| shape[r][i]),
                [3, 4, 5, 6].map(|r| shape[r][i]),
                [7, 8, 9].map(|r| shape[r][i]),
                shape[10][i],
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
        let shape: [Vec<f32>; SHAPE_ROWS] = self.rows(&self.model.shape);
        let [screen, views, absolute]: [Vec<f32>; STAT_ROWS] = self.rows(&self.training.stats);
        self.clear(&self.training.stats);
        let mean = |sums: &[f32]| sums.iter().zip(&views).map(|(sum, views)| sum / views.max(1.0)).collect();
        let each = 0..self.model.len;
        Shapes {
            means: each.clone().map(|i| [0, 1, 2].map(|r| shape[r][i])).collect(),
            quats: each.clone().map(|i| [3, 4, 5, 6].map(|r| shape[r][i])).collect(),
            log_scales: each.map(|i| [7, 8, 9].map(|r| shape[r][i])).collect(),
            opacity_logits: shape[10].clone(),
            screen_gradients: mean(&screen),
            absolute_gradients: mean(&absolute),
            views,
        }
    }

    fn clear_scores(&mut self) {
        self.clear(&self.training.scores);
    }

    fn score(&mut self) {
        self.training.score(&self.gpu, &self.model, &self.drawing);
    }

    fn scores(&self) -> Scores {
        let [squared_weights, hits, observers]: [Vec<f32>; SCORE_ROWS] = self.rows(&self.training.scores);
        Scores { squared_weights, hits, observers }
    }

    fn edit(&mut self, edit: &Edit) {
        self.apply(edit);
    }

    fn cap_opacity(&mut self, opacity: f32) {
        self.lower_opacities(opacity);
    }

    fn export<E>(&self, visit: impl FnMut(&[f32]) -> Result<(), E>) -> Result<(), E> {
        self.visit_kept(visit)
    }

    fn import<E>(&mut self, len: usize, fill: impl FnMut(&mut [f32]) -> Result<(), E>) -> Result<(), E> {
        self.fill_kept(len, fill)
    }
}
