//! Training. A step, [`Trainer::step`], reads as a list of passes of a [`Backend`].

use cosurf_scene::Camera;
use tracing::{debug_span, trace_span};

use crate::backend::{
    AdamRates, Backend, BinCounts, Channels, Edit, Exposure, LossWeights, MultiviewWeights, PatchSide,
    PhotometricLoss, SurfaceLoss, SurfaceWeights, TargetRgb, Targets,
};
use crate::exposure::Exposures;
use crate::neighbours::Neighbours;
use crate::poses::{PoseChoice, Poses, PosesFound};
use crate::prune::{self, PruneScore};
use crate::random::{Purpose, Random};
use crate::refine::{RefineLimits, refine};
use crate::schedule::Schedule;

/// Weight of `1 - SSIM` (3DGS).
pub(crate) const SSIM_WEIGHT: f32 = 0.2;
/// Opacity after a reset (3DGS).
const RESET_OPACITY: f32 = 0.01;

/// Settings of the surface losses (CoSurfGS, "Device-side Training Procedure").
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfaceSettings {
    /// λ₁: weight of the mean shortest scale of the visible splats, with scales in units of the scene's extent.
    pub scale: f32,
    /// β₂: weight of the single-view normal loss, before the factor of [`SurfaceSettings::smooth`]. The paper has 0.01;
    /// a higher weight improves normals and lowers PSNR.
    pub normal: f32,
    /// Weight of the reprojection error between neighbouring views, 1 / px, before the factor of
    /// [`SurfaceSettings::smooth`].
    pub reprojection: f32,
    /// Weight of `1 - NCC²` between patches of neighbouring views, before the factor of [`SurfaceSettings::smooth`].
    /// The paper has 0.2; a higher weight improves the surface and lowers PSNR.
    pub ncc: f32,
    /// Whether all weights except `scale` are multiplied by the paper's smooth weight, [`Schedule::surface_ramp`],
    /// which grows from 0.
    pub smooth: bool,
    /// Side of the square cells in which pixels are sampled, one in each, for the comparison with the neighbouring
    /// view: 1, 2, 4, 8 or 16 px. Larger cells save time and give slightly worse normals.
    pub cell_px: u32,
    /// Side of the patches that are compared with the neighbouring view.
    pub patch: PatchSide,
}

impl Default for SurfaceSettings {
    fn default() -> Self {
        let patch = PatchSide::Px3;
        Self { scale: 100.0, normal: 0.04, reprojection: 0.05, ncc: 1.0, smooth: true, cell_px: 2, patch }
    }
}

impl SurfaceSettings {
    /// The paper's (CoSurfGS, "Device-side Training Procedure" and "Implementation Details"). All pixels of a
    /// picture are compared; PGSR compares at most 102,400 of them.
    #[must_use]
    pub fn paper() -> Self {
        let patch = PatchSide::Px7;
        Self { scale: 25.0, normal: 0.01, reprojection: 0.05, ncc: 0.2, smooth: true, cell_px: 1, patch }
    }
}

/// Settings of Adaptive Gaussian Pruning (CoSurfGS).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PruneSettings {
    /// φ: share of the splats that is removed, 0..1.
    pub ratio: f64,
    /// Share of the steps after which the splats are removed, 0..=1.
    pub at: f64,
    /// Formula for the importance of a splat.
    pub score: PruneScore,
}

impl Default for PruneSettings {
    /// As in the paper's ablations: a ratio of 0.4, after 20,000 of 30,000 steps.
    fn default() -> Self {
        Self { ratio: 0.4, at: 2.0 / 3.0, score: PruneScore::default() }
    }
}

impl PruneSettings {
    /// The paper's: its ratio in the text, and its formula.
    #[must_use]
    pub fn paper() -> Self {
        Self { ratio: 0.2, score: PruneScore::Paper, ..Self::default() }
    }
}

/// The views of a training.
#[derive(Clone, Debug, Default)]
pub struct TrainingViews {
    /// Cameras of the photographs.
    pub cameras: Vec<Camera>,
    /// For each view, the views that it may be compared with.
    pub neighbours: Neighbours,
}

/// The input of one step.
#[derive(Clone, Copy, Debug)]
pub struct Example<'a> {
    /// Index of the view in [`TrainingViews::cameras`].
    pub view: usize,
    /// Photograph of the view.
    pub rgb: TargetRgb<'a>,
    /// Index and photograph of the neighbouring view that [`Trainer::neighbour_index`] returns, if any.
    pub neighbour: Option<(usize, TargetRgb<'a>)>,
}

/// Settings of a training.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrainSettings {
    /// Phases and learning rates.
    pub schedule: Schedule,
    /// Scene extent: 1.1 × the largest distance of a camera centre from the mean of all camera centres, world units.
    pub extent: f64,
    /// Stored SH degree, 0..=3.
    pub sh_degree: u32,
    /// Settings of the surface losses; `None` trains with the colour loss only.
    pub surface: Option<SurfaceSettings>,
    /// Settings of pruning; `None` does not prune.
    pub prune: Option<PruneSettings>,
    /// Whether to train an exposure for each photograph.
    pub exposure: bool,
    /// Whether to learn the poses of the photographs.
    pub poses: PoseChoice,
    /// Splats that are observed by fewer views than this are removed (PGSR: 2). It may be 1 if this model is one of
    /// several, because views of other models may observe the same splats.
    pub observers_min: u32,
    /// Refinement adds no splats beyond this number, nor beyond the backend's capacity.
    pub splats_max: usize,
    /// Seed of every random choice.
    pub seed: u64,
}

/// Result of a step.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StepOutcome {
    /// Colour losses before the step.
    pub loss: PhotometricLoss,
    /// Surface losses before the step; zero in steps without surface losses.
    pub surface: SurfaceLoss,
    /// Counts of the binning pass of the view.
    pub counts: BinCounts,
}

/// Trains a backend's splats.
///
/// ```
/// use cosurf_engine::backend::{Channels, TargetRgb};
/// use cosurf_engine::{
///     Backend, Capacity, CpuBackend, Example, Neighbours, PoseChoice, Schedule, TrainSettings, Trainer, TrainingViews,
/// };
/// use cosurf_scene::{Camera, Pose, Splats};
/// use glam::{DVec2, DVec3};
///
/// // Black splats learn from one photograph that is grey all over.
/// let mut splats = Splats::with_capacity(25, 0);
/// for i in 0..25u8 {
///     let [x, y] = [i % 5, i / 5].map(|v| 0.2 * (f32::from(v) - 2.0));
///     splats.push([x, y, 0.0], [1.0, 0.0, 0.0, 0.0], [-2.0; 3], 2.0, &[-1.7; 3]);
/// }
/// let camera = Camera {
///     cam_from_world: Pose::look_at(DVec3::new(0.0, 0.0, 2.0), DVec3::ZERO, DVec3::Y),
///     focal_px: DVec2::splat(60.0),
///     center_px: DVec2::splat(16.0),
///     size_px: [32, 32],
/// };
/// let photograph = [128u8; 3 * 32 * 32];
///
/// let mut backend = CpuBackend::new(Capacity::to_train(&splats, &[camera], Channels::Color), 1);
/// backend.load(&splats);
/// let settings = TrainSettings {
///     schedule: Schedule::new(100),
///     extent: 2.0,
///     sh_degree: 0,
///     surface: None,
///     prune: None,
///     exposure: false,
///     poses: PoseChoice::Fixed,
///     observers_min: 1,
///     splats_max: 25,
///     seed: 1,
/// };
/// let views = TrainingViews { cameras: vec![camera], neighbours: Neighbours::none() };
/// let mut trainer = Trainer::new(backend, settings, views);
/// let mut losses = Vec::new();
/// while !trainer.is_done() {
///     let view = trainer.view_index(0);
///     let example = Example { view, rgb: TargetRgb::Bytes(&photograph), neighbour: None };
///     losses.push(trainer.step(&example).loss.total);
/// }
/// assert!(losses[99] < 0.9 * losses[0], "{} after {}", losses[99], losses[0]);
/// ```
pub struct Trainer<B> {
    backend: B,
    settings: TrainSettings,
    views: TrainingViews,
    exposures: Option<Exposures>,
    poses: Option<Poses>,
    steps_done: u32,
    splats_at_start: usize,
}

/// Progress of a training. Together with the numbers that [`Trainer::export`] visits, it forms a checkpoint.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Progress {
    /// Steps done.
    pub steps_done: u32,
    /// Number of splats at step 0.
    pub splats_at_start: usize,
    /// Number of splats now.
    pub splats: usize,
}

impl<B: Backend> Trainer<B> {
    /// Starts with the splats that the backend holds.
    pub fn new(backend: B, settings: TrainSettings, views: TrainingViews) -> Self {
        let haste = settings.schedule.exposure_haste();
        let exposures = settings.exposure.then(|| Exposures::new(views.cameras.len(), haste));
        let poses = Poses::new(settings.poses, &settings.schedule, &views.cameras, settings.extent);
        let splats_at_start = backend.len();
        Self { backend, settings, views, exposures, poses, steps_done: 0, splats_at_start }
    }

    /// The settings of the training.
    pub fn settings(&self) -> &TrainSettings {
        &self.settings
    }

    /// Steps done so far.
    pub fn steps_done(&self) -> u32 {
        self.steps_done
    }

    /// Progress of the training.
    pub fn progress(&self) -> Progress {
        let Self { steps_done, splats_at_start, .. } = *self;
        Progress { steps_done, splats_at_start, splats: self.backend.len() }
    }

    /// Calls `visit` with all trained numbers, in pieces and in a fixed order. Stops at the first error.
    pub fn export<E>(&self, mut visit: impl FnMut(&[f32]) -> Result<(), E>) -> Result<(), E> {
        self.backend.export(&mut visit)?;
        self.exposures.iter().try_for_each(|exposures| exposures.export(&mut visit))?;
        self.poses.iter().try_for_each(|poses| poses.export(&mut visit))
    }

    /// Resumes a training with the same settings. Calls `fill` with the pieces that [`Trainer::export`] visited, in the
    /// same order. Stops at the first error. Panics if the splats exceed the backend's capacity.
    pub fn import<E>(
        &mut self,
        progress: Progress,
        mut fill: impl FnMut(&mut [f32]) -> Result<(), E>,
    ) -> Result<(), E> {
        (self.steps_done, self.splats_at_start) = (progress.steps_done, progress.splats_at_start);
        self.backend.import(progress.splats, &mut fill)?;
        self.exposures.iter_mut().try_for_each(|exposures| exposures.import(&mut fill))?;
        self.poses
            .iter_mut()
            .try_for_each(|poses| poses.import(&mut self.views.cameras, progress.steps_done, &mut fill))
    }

    /// What is known about the poses so far; `None` if they are fixed or have not been looked at yet.
    pub fn poses_found(&self) -> Option<PosesFound> {
        self.poses.as_ref().and_then(|poses| poses.found(self.steps_done))
    }

    /// Whether all steps are done.
    pub fn is_done(&self) -> bool {
        self.steps_done >= self.settings.schedule.steps
    }

    /// The backend that holds the splats.
    pub fn backend(&self) -> &B {
        &self.backend
    }

    /// Ends the training and returns the backend.
    pub fn into_backend(self) -> B {
        self.backend
    }

    /// Cameras of the photographs, with the poses as they are now.
    pub fn cameras(&self) -> &[Camera] {
        &self.views.cameras
    }

    /// Index of the view of the step that comes `ahead` steps after the next step; 0 is the next step itself. Each
    /// epoch visits all views in a new order.
    pub fn view_index(&self, ahead: u32) -> usize {
        let views = self.views.cameras.len();
        let step = u64::from(self.steps_done + ahead);
        let (epoch, place) = (step / views as u64, step % views as u64);
        view_order(self.settings.seed, epoch, views)[place as usize]
    }

    /// Index of the neighbouring view with which `view` is compared in the step that comes `ahead` steps after the next
    /// step; `None` if that step has no such comparison.
    pub fn neighbour_index(&self, view: usize, ahead: u32) -> Option<usize> {
        let step = self.steps_done + ahead;
        self.settings.surface?;
        self.settings.schedule.surface_ramp(step)?;
        self.views.neighbours.draw(view, self.settings.seed, step)
    }

    /// Trains one step on one view. Refines, removes unobserved splats, prunes and resets opacities when the schedule
    /// says so.
    pub fn step(&mut self, example: &Example) -> StepOutcome {
        let TrainSettings { schedule, sh_degree, .. } = self.settings;
        let step = self.steps_done;
        let _span = trace_span!("step", step, view = example.view).entered();
        let degree = schedule.sh_degree(step, sh_degree);
        let (weights, rates) = (self.weights(step), self.rates(step));
        if let Some(poses) = &mut self.poses {
            poses.begin(&mut self.views.cameras, step);
        }
        let aligns = self.poses.as_ref().is_some_and(|poses| poses.aligns(step));
        let channels = if weights.surface.is_some() || aligns { Channels::Geometry } else { Channels::Color };
        let (backend, cameras) = (&mut self.backend, &self.views.cameras);
        if let (Some(_), Some((neighbour, _))) = (weights.surface, example.neighbour) {
            backend.project(&cameras[neighbour], 0);
            backend.bin();
            backend.rasterize(Channels::Geometry);
            backend.keep_neighbour();
        }
        backend.project(&cameras[example.view], degree);
        backend.bin();
        backend.rasterize(channels);
        let losses = backend.losses(&targets(example, self.exposures.as_ref()), &weights);
        let counts = backend.counts();
        backend.rasterize_backward();
        backend.project_backward();
        backend.adam(&rates);
        if let (Some(poses), true) = (&mut self.poses, aligns) {
            let rendering = self.backend.rendering();
            let cameras = &mut self.views.cameras;
            self.backend.with_threads(|| poses.update(cameras, example.view, &rendering, example.rgb, step));
        }
        if let Some(exposures) = &mut self.exposures {
            exposures.update(example.view, &losses.color, schedule.trains_exposures(step));
        }
        self.steps_done += 1;
        if schedule.refines_after(self.steps_done) {
            self.refine();
        }
        if schedule.observes_after(self.steps_done, self.views.cameras.len()) {
            let scores = prune::survey(&mut self.backend, &self.views.cameras);
            self.remove(prune::unobserved(&scores, self.settings.observers_min));
        }
        if let Some(settings) = self.settings.prune.filter(|prune| schedule.is_at(prune.at, self.steps_done))
        {
            self.prune(&settings);
        }
        if schedule.resets_after(self.steps_done) {
            self.backend.cap_opacity(RESET_OPACITY);
        }
        StepOutcome { loss: losses.color, surface: losses.surface, counts }
    }

    /// Loss weights of a step (counted from 0).
    fn weights(&self, step: u32) -> LossWeights {
        let TrainSettings { schedule, extent, surface, seed, .. } = self.settings;
        let scale = surface.map_or(0.0, |surface| f64::from(surface.scale) / extent) as f32;
        let surface = surface.zip(schedule.surface_ramp(step)).map(|(surface, ramp)| {
            let ramp = if surface.smooth { ramp } else { 1.0 };
            SurfaceWeights {
                normal: ramp * surface.normal,
                multiview: Some(MultiviewWeights {
                    reprojection: ramp * surface.reprojection,
                    ncc: ramp * surface.ncc,
                    cell_px: surface.cell_px,
                    patch: surface.patch,
                    draw: Random::new(seed, Purpose::Sample, u64::from(step), 0).next_u64(),
                }),
            }
        });
        LossWeights { ssim: SSIM_WEIGHT, scale, surface, teacher: None }
    }

    /// Learning rates of a step (counted from 0).
    fn rates(&self, step: u32) -> AdamRates {
        let TrainSettings { schedule, extent, surface, .. } = self.settings;
        let rates = schedule.rates(step, extent);
        // After the surface losses end, the colour loss alone would rotate and stretch the splats, so their shapes are
        // frozen.
        let shaped = surface.is_some() && step >= schedule.surface_until;
        if shaped { AdamRates { quat: 0.0, log_scale: 0.0, ..rates } } else { rates }
    }

    fn prune(&mut self, settings: &PruneSettings) {
        let _span = debug_span!("prune", splats = self.backend.len()).entered();
        let scores = prune::survey(&mut self.backend, &self.views.cameras);
        let importance = prune::importance_by(&self.backend.take_shapes(), &scores, settings.score);
        self.remove(prune::lowest(&importance, settings.ratio));
    }

    fn remove(&mut self, deaths: Vec<u32>) {
        self.backend.edit(&Edit { births: Vec::new(), deaths });
    }

    fn refine(&mut self) {
        let _span = debug_span!("refine", splats = self.backend.len()).entered();
        let TrainSettings { schedule, extent, splats_max, .. } = self.settings;
        // The growth is spread over all refinements, so that early splats are trained before they split.
        let end = splats_max.min(self.backend.capacity());
        let room = end.saturating_sub(self.splats_at_start) as f64 * schedule.growth(self.steps_done);
        let limits = RefineLimits {
            splats_max: end.min(self.splats_at_start + room as usize),
            extent,
            prune_large: schedule.reset_every > 0 && self.steps_done > schedule.reset_every,
        };
        let shapes = self.backend.take_shapes();
        let edit = self.backend.with_threads(|| refine(&shapes, &limits));
        self.backend.edit(&edit);
    }
}

/// What the rendering of an example is compared with.
fn targets<'a>(example: &Example<'a>, exposures: Option<&Exposures>) -> Targets<'a> {
    Targets {
        exposure: exposures.map_or_else(Exposure::default, |exposures| exposures.of(example.view)),
        neighbour_rgb: example.neighbour.map(|(_, rgb)| rgb),
        ..Targets::colors(example.rgb)
    }
}

/// The order in which an epoch visits the views: a random permutation (Fisher–Yates), determined by seed and epoch.
pub fn view_order(seed: u64, epoch: u64, views: usize) -> Vec<usize> {
    let mut random = Random::new(seed, Purpose::ViewOrder, epoch, 0);
    let mut order: Vec<usize> = (0..views).collect();
    for last in (1..views).rev() {
        order.swap(last, random.below(last as u64 + 1) as usize);
    }
    order
}

#[cfg(test)]
mod tests;
