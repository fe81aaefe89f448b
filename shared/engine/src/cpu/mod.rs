//! The CPU backend: SIMD and threads, the same bits for any number of threads.
//!
//! Threads only ever own separate stretches of memory (blocks of splats, tiles, bands of lines); sums
//! across them are made afterwards, in a fixed order. Reading order: `blocks` for the layout, then the
//! passes as a step calls them: `project`, `bin`, `rasterize`, `loss`, `rasterize_backward`,
//! `project_backward`, `adam`.

mod adam;
mod bin;
mod blocks;
mod edit;
mod geometry;
pub(crate) mod image;
mod loss;
pub(crate) mod project;
mod project_backward;
pub(crate) mod rasterize;
mod rasterize_backward;
pub(crate) mod read;
mod score;
pub(crate) mod sh;
pub(crate) mod simd;
pub(crate) mod surface;
#[cfg(test)]
pub(crate) mod tests;
pub(crate) mod view;

use cosurf_scene::{Camera, Splats};

use crate::backend::{
    AdamRates, Backend, BinCounts, Channels, Edit, LossWeights, Losses, Rendering, Scores, Shapes,
    SurfaceLoss, Targets, TeacherLoss,
};
use adam::Moments;
use bin::TileLists;
use blocks::{Blocks, rows_per_block};
use image::{TileImage, padded_pixels};
use project::Projection;
use project_backward::{GRADIENT_ROWS, STAT_ROWS};
use rasterize::{PLANES_COLOR, PLANES_GEOMETRY};
use score::SCORE_ROWS;
use simd::Isa;
use surface::Surface;
use view::ViewParams;

/// Everything that has a size, decided before anything is allocated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CpuCapacity {
    /// Most splats.
    pub splats: usize,
    /// Most splat–tile pairs of one view.
    pub pairs: usize,
    /// Largest picture.
    pub size_px: [u32; 2],
    /// Stored SH degree, 0..=3.
    pub sh_degree: u32,
    /// Channels that will be asked for.
    pub channels: Channels,
    /// Whether the optimiser's buffers are wanted; false for rendering only.
    pub training: bool,
}

/// Splat–tile pairs per splat: aerial views need 2 to 4 where all of the model is in the picture.
pub const PAIRS_PER_SPLAT: usize = 5;

impl CpuCapacity {
    /// Room to train or to score `splats` under `cameras`.
    pub fn to_train(splats: &Splats, cameras: &[Camera], channels: Channels) -> Self {
        Self {
            splats: splats.len(),
            pairs: PAIRS_PER_SPLAT * splats.len(),
            size_px: [0, 1].map(|axis| cameras.iter().map(|camera| camera.size_px[axis]).max().unwrap_or(1)),
            sh_degree: splats.sh_degree,
            channels,
            training: true,
        }
    }

    /// Bytes per splat of all buffers whose length is the number of splats.
    pub const fn splat_bytes(sh_degree: u32, training: bool) -> usize {
        let parameters = 4 * rows_per_block(sh_degree);
        // Projected 64 + depth 4 + visible bit, sort keys 16, slots 8, spans and touched lists about 3 × 16 + 8.
        let drawn = 64 + 4 + 1 + 16 + 8 + 56;
        if training {
            3 * parameters + 4 * (GRADIENT_ROWS + STAT_ROWS + SCORE_ROWS) + drawn
        } else {
            parameters + drawn
        }
    }

    /// Bytes per splat–tile pair: list and slot entries 8, record 64.
    pub const fn pair_bytes(training: bool) -> usize {
        if training { 8 + 64 } else { 8 }
    }

    /// Bytes of the pictures: rendered and gradient planes, and what the losses of the surface compare.
    pub fn picture_bytes(size_px: [u32; 2], channels: Channels, training: bool) -> usize {
        let rendered = padded_pixels(size_px) * planes(channels) * 4;
        match (training, channels) {
            (false, _) => rendered,
            (true, Channels::Color) => 2 * rendered,
            (true, Channels::Geometry) => {
                2 * rendered + 4 * surface::PLANES * surface::Plane::len_for(size_px)
            }
        }
    }

    /// Bytes of everything.
    pub fn total_bytes(&self) -> usize {
        self.splats * Self::splat_bytes(self.sh_degree, self.training)
            + self.pairs * Self::pair_bytes(self.training)
            + Self::picture_bytes(self.size_px, self.channels, self.training)
    }
}

fn planes(channels: Channels) -> usize {
    match channels {
        Channels::Color => PLANES_COLOR,
        Channels::Geometry => PLANES_GEOMETRY,
    }
}

/// Splats on the CPU.
pub struct CpuBackend {
    isa: Isa,
    pool: rayon::ThreadPool,
    capacity: CpuCapacity,
    params: Blocks,
    moments: Moments,
    gradients: Blocks,
    stats: Blocks,
    scores: Blocks,
    view: Option<ViewParams>,
    projection: Projection,
    lists: TileLists,
    image: TileImage,
    gradient: TileImage,
    blended: Vec<u32>,
    records: Vec<rasterize_backward::Record>,
    surface: Surface,
    /// Weight of the scale loss in the backward pass that comes.
    scale_weight: f32,
}

impl CpuBackend {
    /// Allocates every buffer. `threads` is at least 1.
    pub fn new(capacity: CpuCapacity, threads: usize) -> Self {
        Self::with_isa(capacity, threads, Isa::best())
    }

    fn with_isa(capacity: CpuCapacity, threads: usize, isa: Isa) -> Self {
        assert!(
            threads >= 1 && capacity.sh_degree <= 3,
            "{threads} threads, SH degree {}",
            capacity.sh_degree
        );
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .thread_name(|index| format!("cosurf-{index}"))
            .build()
            .expect("the operating system starts threads");
        let CpuCapacity { splats, pairs, size_px, sh_degree, channels, training } = capacity;
        let trained = if training { splats } else { 0 };
        let rows = rows_per_block(sh_degree);
        let pixels = padded_pixels(size_px);
        Self {
            isa,
            pool,
            capacity,
            params: Blocks::with_capacity(splats, rows),
            moments: Moments {
                first: Blocks::with_capacity(trained, rows),
                second: Blocks::with_capacity(trained, rows),
            },
            gradients: Blocks::with_capacity(trained, GRADIENT_ROWS),
            stats: Blocks::with_capacity(trained, STAT_ROWS),
            scores: Blocks::with_capacity(trained, SCORE_ROWS),
            view: None,
            projection: Projection::with_capacity(splats),
            lists: TileLists::with_capacity(splats, pairs),
            image: TileImage::with_capacity(pixels, planes(channels)),
            gradient: TileImage::with_capacity(if training { pixels } else { 0 }, planes(channels)),
            blended: Vec::new(),
            records: Vec::with_capacity(if training { pairs } else { 0 }),
            surface: Surface::with_capacity(match (training, channels) {
                (true, Channels::Geometry) => size_px,
                _ => [0, 0],
            }),
            scale_weight: 0.0,
        }
    }

    /// Makes room for this many splat–tile pairs in one view.
    pub(crate) fn set_pair_capacity(&mut self, pairs: usize) {
        self.lists.set_capacity(pairs);
    }

    fn seen_view(&self) -> &ViewParams {
        self.view.as_ref().expect("`project` comes first")
    }
}

impl Backend for CpuBackend {
    fn device(&self) -> String {
        format!("cpu {} × {}", self.isa.name(), self.pool.current_num_threads())
    }

    fn len(&self) -> usize {
        self.params.len()
    }

    fn capacity(&self) -> usize {
        self.capacity.splats
    }

    fn load(&mut self, splats: &Splats) {
        assert!(splats.len() <= self.capacity.splats, "{} splats of {}", splats.len(), self.capacity.splats);
        blocks::store_splats(&mut self.params, splats);
        if self.capacity.training {
            self.reset_training_state();
        }
    }

    fn splats(&self) -> Splats {
        blocks::load_splats(&self.params, self.capacity.sh_degree)
    }

    fn project(&mut self, camera: &Camera, sh_degree: u32) {
        let view = ViewParams::new(camera, sh_degree.min(self.capacity.sh_degree));
        self.pool.install(|| project::project(self.isa, &self.params, &view, &mut self.projection));
        self.view = Some(view);
    }

    fn bin(&mut self) -> BinCounts {
        let view = self.view.as_ref().expect("`project` comes first");
        self.pool.install(|| self.lists.fill(&self.projection, view))
    }

    fn rasterize(&mut self, channels: Channels) {
        self.image.reshape(self.seen_view().size_px, planes(channels));
        self.pool.install(|| {
            let splats = &self.projection.splats;
            rasterize::rasterize(self.isa, &self.lists, splats, &mut self.image, &mut self.blended);
        });
    }

    fn keep_neighbour(&mut self) {
        let view = self.view.as_ref().expect("`project` comes first");
        self.pool.install(|| self.surface.keep_neighbour(self.isa, &self.image, view));
    }

    fn losses(&mut self, targets: &Targets, weights: &LossWeights) -> Losses {
        let view = *self.seen_view();
        self.gradient.reshape(view.size_px, self.image.planes());
        self.scale_weight = weights.scale;
        self.pool.install(|| {
            let (image, gradient) = (&self.image, &mut self.gradient);
            let Targets { rgb, exposure, .. } = *targets;
            let color = loss::photometric(self.isa, image, rgb, exposure, weights.ssim, gradient);
            let surface = match &weights.surface {
                Some(weights) => self.surface.losses(self.isa, image, &view, targets, weights, gradient),
                None => SurfaceLoss::default(),
            };
            let teacher = match (&weights.teacher, &targets.surface) {
                (Some(weights), Some(target)) => {
                    self.surface.teach(self.isa, image, &view, target, weights, gradient)
                }
                _ => TeacherLoss::default(),
            };
            Losses { color, surface, teacher }
        })
    }

    fn rasterize_backward(&mut self) {
        self.pool.install(|| {
            let splats = &self.projection.splats;
            rasterize_backward::rasterize_backward(
                self.isa,
                &self.lists,
                splats,
                &self.image,
                &self.gradient,
                &self.blended,
                &mut self.records,
            );
        });
    }

    fn project_backward(&mut self) {
        let inputs = project_backward::Inputs {
            params: &self.params,
            view: self.view.as_ref().expect("`project` comes first"),
            projection: &self.projection,
            lists: &self.lists,
            records: &self.records,
            planes: self.image.planes(),
            scale_weight: self.scale_weight,
        };
        self.pool.install(|| {
            project_backward::project_backward(self.isa, &inputs, &mut self.gradients, &mut self.stats);
        });
    }

    fn gradients(&self) -> Splats {
        let seen = &self.projection.visible;
        read::gradients(&self.params, &self.gradients, seen, self.seen_view(), self.capacity.sh_degree)
    }

    fn adam(&mut self, rates: &AdamRates) {
        let view = self.view.as_ref().expect("`project` comes first");
        self.pool.install(|| {
            let visible = &self.projection.visible;
            adam::adam(self.isa, &mut self.params, &mut self.moments, &self.gradients, visible, view, rates);
        });
    }

    fn rendering(&self) -> Rendering {
        read::rendering(&self.image, self.seen_view())
    }

    fn take_shapes(&mut self) -> Shapes {
        let shapes = read::shapes(&self.params, &self.stats);
        self.stats.fill_zero();
        shapes
    }

    fn clear_scores(&mut self) {
        self.scores.resize(0);
        self.scores.resize(self.params.len());
    }

    fn score(&mut self) {
        let Self { isa, projection, lists, image, blended, records, scores, .. } = self;
        self.pool.install(|| {
            score::score(*isa, lists, &projection.splats, image, blended, records);
            score::collect(projection, lists, records, scores);
        });
    }

    fn scores(&self) -> Scores {
        read::scores(&self.scores)
    }

    fn edit(&mut self, edit: &Edit) {
        self.apply(edit);
    }

    fn cap_opacity(&mut self, opacity: f32) {
        self.lower_opacities(opacity);
    }

    fn export<E>(&self, mut visit: impl FnMut(&[f32]) -> Result<(), E>) -> Result<(), E> {
        for blocks in [&self.params, &self.moments.first, &self.moments.second, &self.stats] {
            blocks.rows().iter().try_for_each(|row| visit(&row.0))?;
        }
        Ok(())
    }

    fn import<E>(&mut self, len: usize, mut fill: impl FnMut(&mut [f32]) -> Result<(), E>) -> Result<(), E> {
        assert!(len <= self.capacity.splats, "{len} splats of {}", self.capacity.splats);
        self.gradients.resize(len);
        for blocks in [&mut self.params, &mut self.moments.first, &mut self.moments.second, &mut self.stats] {
            blocks.resize(len);
            blocks.rows_mut().iter_mut().try_for_each(|row| fill(&mut row.0))?;
        }
        Ok(())
    }
}
