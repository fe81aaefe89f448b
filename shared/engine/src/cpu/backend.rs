//! The CPU as a [`Backend`], with buffers that are allocated once and a thread pool for the passes.

use cosurf_scene::{Camera, Splats};

use super::bin::TileLists;
use super::blocks::Blocks;
use super::loss::Photometric;
use super::model::Model;
use super::project::{self, Projection};
use super::records::Record;
use super::surface::Surface;
use super::{adam, project_backward, rasterize, rasterize_backward, read, score};
use crate::backend::{
    AdamRates, Backend, BinCounts, Channels, Edit, LossWeights, Losses, Rendering, Scores, Shapes,
    SurfaceLoss, Targets, TeacherLoss,
};
use crate::budget::Capacity;
use crate::layout::planes::planes;
use crate::layout::rendering;
use crate::layout::rows::SCORE_ROWS;
use crate::layout::tiles::{TileImage, padded_pixels};
use crate::layout::view::ViewParams;
use crate::simd::Isa;

/// Trains and renders splats on the CPU.
///
/// The passes of a rendering, in order:
///
/// ```
/// use cosurf_engine::backend::Channels;
/// use cosurf_engine::{Backend, Capacity, CpuBackend};
/// use cosurf_scene::{Camera, Pose, Splats};
/// use glam::{DVec2, DVec3};
///
/// // One grey splat at the origin, 0.1 wide and almost opaque, and a camera 2 above it.
/// let mut splats = Splats::with_capacity(1, 0);
/// splats.push([0.0; 3], [1.0, 0.0, 0.0, 0.0], [0.1f32.ln(); 3], 4.0, &[0.0; 3]);
/// let camera = Camera {
///     cam_from_world: Pose::look_at(DVec3::new(0.0, 0.0, 2.0), DVec3::ZERO, DVec3::Y),
///     focal_px: DVec2::splat(60.0),
///     center_px: DVec2::splat(16.0),
///     size_px: [32, 32],
/// };
///
/// let capacity = Capacity::to_train(&splats, &[camera], Channels::Geometry);
/// let mut backend = CpuBackend::new(capacity, 1);
/// backend.load(&splats);
/// backend.project(&camera, 0);
/// backend.bin();
/// assert_eq!(backend.counts().visible, 1);
/// backend.rasterize(Channels::Geometry);
/// let picture = backend.rendering();
/// assert!(picture.alpha[16 * 32 + 16] > 0.9 && picture.alpha[0] == 0.0);
/// ```
pub struct CpuBackend {
    isa: Isa,
    pool: rayon::ThreadPool,
    pub(super) model: Model,
    scores: Blocks,
    view: Option<ViewParams>,
    pub(super) projection: Projection,
    lists: TileLists,
    counts: BinCounts,
    pub(super) image: TileImage,
    pub(super) gradient: TileImage,
    /// For each tile, the number of entries of its list that were processed: all, or fewer if all its pixels became
    /// full.
    blended: Vec<u32>,
    records: Vec<Record>,
    photometric: Photometric,
    surface: Surface,
    /// Weight of the scale loss in the next backward pass, 1 / world units.
    pub(super) scale_weight: f32,
}

impl CpuBackend {
    /// Allocates every buffer. `threads` is at least 1.
    pub fn new(capacity: Capacity, threads: usize) -> Self {
        Self::with_isa(capacity, threads, Isa::best())
    }

    pub(super) fn with_isa(capacity: Capacity, threads: usize, isa: Isa) -> Self {
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
        let Capacity { splats, pairs, size_px, channels, training, .. } = capacity;
        let pixels = padded_pixels(size_px);
        let trained_px = if training { size_px } else { [0, 0] };
        let surface_px = if channels == Channels::Geometry { trained_px } else { [0, 0] };
        Self {
            isa,
            pool,
            model: Model::with_capacity(&capacity),
            scores: Blocks::with_capacity(if training { splats } else { 0 }, SCORE_ROWS),
            view: None,
            projection: Projection::with_capacity(splats),
            lists: TileLists::with_capacity(splats, pairs, size_px),
            counts: BinCounts::default(),
            image: TileImage::with_capacity(pixels, planes(channels)),
            gradient: TileImage::with_capacity(padded_pixels(trained_px), planes(channels)),
            blended: Vec::with_capacity(TileImage::tiles_of(size_px).iter().product()),
            records: Vec::with_capacity(if training { pairs } else { 0 }),
            photometric: Photometric::with_capacity(trained_px, threads),
            surface: Surface::with_capacity(surface_px, threads),
            scale_weight: 0.0,
        }
    }

    /// Sets the capacity for splat–tile pairs of one view; the lists grow when they are filled.
    pub(crate) fn set_pair_capacity(&mut self, pairs: usize) {
        self.lists.set_capacity(pairs);
    }

    /// As [`Self::set_pair_capacity`], and makes exactly this room at once, so that nothing grows later.
    pub(crate) fn reserve_pairs(&mut self, pairs: usize) {
        self.lists.set_capacity(pairs);
        self.lists.reserve(pairs);
    }

    /// Indices of the splats that the projected view shows, ascending.
    pub(crate) fn visible(&self) -> impl Iterator<Item = usize> {
        self.projection.visible()
    }

    /// The splats with their training state; all else is freed.
    fn into_model(self) -> Model {
        self.model
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
        self.model.len()
    }

    fn capacity(&self) -> usize {
        self.model.capacity()
    }

    fn load(&mut self, splats: &Splats) {
        self.model.load(splats);
    }

    fn splats(&self) -> Splats {
        self.model.splats()
    }

    fn into_splats(self) -> Splats {
        self.into_model().into_splats()
    }

    fn project_up_to(&mut self, camera: &Camera, sh_degree: u32, far: f64) {
        let view = ViewParams::new(camera, sh_degree.min(self.model.sh_degree())).up_to(far);
        self.pool.install(|| project::project(self.isa, &self.model.params, &view, &mut self.projection));
        self.view = Some(view);
    }

    fn bin(&mut self) {
        let view = self.view.as_ref().expect("`project` comes first");
        self.counts = self.pool.install(|| self.lists.fill(&self.projection, view));
    }

    fn counts(&self) -> BinCounts {
        self.counts
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
            let color = self.photometric.loss(self.isa, image, rgb, exposure, weights.ssim, gradient);
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
            params: &self.model.params,
            view: self.view.as_ref().expect("`project` comes first"),
            projection: &self.projection,
            lists: &self.lists,
            records: &self.records,
            planes: self.image.planes(),
            scale_weight: self.scale_weight,
        };
        let (gradients, stats) = (&mut self.model.gradients, &mut self.model.stats);
        self.pool.install(|| project_backward::project_backward(self.isa, &inputs, gradients, stats));
    }

    fn gradients(&self) -> Splats {
        let Model { params, gradients, .. } = &self.model;
        let seen = &self.projection.visible;
        read::gradients(params, gradients, seen, self.seen_view(), self.model.sh_degree())
    }

    fn adam(&mut self, rates: &AdamRates) {
        let view = self.view.as_ref().expect("`project` comes first");
        let Model { params, moments, gradients, .. } = &mut self.model;
        let visible = &self.projection.visible;
        self.pool.install(|| adam::adam(self.isa, params, moments, gradients, visible, view, rates));
    }

    fn rendering(&self) -> Rendering {
        self.pool.install(|| rendering::rendering(&self.image, self.seen_view()))
    }

    fn with_threads<R: Send>(&self, job: impl FnOnce() -> R + Send) -> R {
        self.pool.install(job)
    }

    fn take_shapes(&mut self) -> Shapes {
        let Self { pool, model, .. } = self;
        pool.install(|| model.take_shapes())
    }

    fn clear_scores(&mut self) {
        self.scores.resize(0);
        self.scores.resize(self.model.len());
    }

    fn score(&mut self) {
        let Self { isa, projection, lists, image, blended, records, scores, .. } = self;
        self.pool.install(|| {
            score::score(*isa, lists, &projection.splats, image, blended, records);
            score::collect(projection, lists, records, scores);
        });
    }

    fn may_score_new_hits(&self, first: usize) -> bool {
        score::may_add_hits(&self.projection, &self.scores, first)
    }

    fn scores(&self) -> Scores {
        read::scores(&self.scores)
    }

    fn edit(&mut self, edit: &Edit) {
        let Self { pool, model, .. } = self;
        pool.install(|| model.edit(edit));
    }

    fn cap_opacity(&mut self, opacity: f32) {
        self.model.cap_opacity(opacity);
    }

    fn export<E>(&self, visit: impl FnMut(&[f32]) -> Result<(), E>) -> Result<(), E> {
        self.model.export(visit)
    }

    fn import<E>(&mut self, len: usize, fill: impl FnMut(&mut [f32]) -> Result<(), E>) -> Result<(), E> {
        self.model.import(len, fill)
    }
}
