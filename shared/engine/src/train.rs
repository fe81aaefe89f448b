//! Training: one step reads as its list of passes.

use cosurf_scene::Camera;

use crate::backend::{
    AdamRates, Backend, BinCounts, Channels, Edit, Exposure, LossWeights, MultiviewWeights, PhotometricLoss,
    SurfaceLoss, SurfaceWeights, TargetRgb, Targets,
};
use crate::exposure::Exposures;
use crate::neighbours::Neighbours;
use crate::prune::{self, PruneScore};
use crate::random::{Purpose, Random};
use crate::refine::{RefineLimits, refine};
use crate::schedule::Schedule;

/// Weight of `1 - SSIM` (3DGS).
pub(crate) const SSIM_WEIGHT: f32 = 0.2;
/// Opacity after a reset (3DGS).
const RESET_OPACITY: f32 = 0.01;

/// How the surface is trained (CoSurfGS, "Device-side Training Procedure").
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfaceSettings {
    /// λ₁: weight of the mean shortest scale, as a share of the scene's extent.
    pub scale: f32,
    /// β₂: weight of the single-view normal loss at the end of an endless ramp. The paper has 0.01. On rendered Boruszyn
    /// (240 px, 3,000 steps) 0.05 instead of 0.04 turns normals by 0.05° (median) nearer to the truth at 0.1 dB less.
    pub normal: f32,
    /// Of the reprojection error.
    pub reprojection: f32,
    /// Of `1 - NCC²`. The paper has 0.2. On rendered Boruszyn (240 px, 3,000 steps) 1 gives an F-score of 0.896 and normals
    /// off by 6.9° (median), 1.5 one of 0.902 and 6.9° at 0.2 dB less.
    pub ncc: f32,
    /// Whether the weights grow from nothing (the paper's smooth weight) or are what they are from the start.
    pub smooth: bool,
    /// One pixel in each square of this side is compared with the neighbour: 1, 2, 4, 8 or 16 px. By 4 instead of 2,
    /// normals of the built-in town (320 px, 3,000 steps) are off by 10.0° (median) instead of 9.7°, those of rendered
    /// Boruszyn (240 px) by 7.3° instead of 7.2°.
    pub cell_px: u32,
}

impl Default for SurfaceSettings {
    fn default() -> Self {
        Self { scale: 100.0, normal: 0.04, reprojection: 0.05, ncc: 1.0, smooth: true, cell_px: 2 }
    }
}

/// Adaptive Gaussian Pruning (CoSurfGS).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PruneSettings {
    /// φ: share of the splats that go, 0..1.
    pub ratio: f64,
    /// Share of the steps after which they go, 0..=1.
    pub at: f64,
    /// What decides.
    pub score: PruneScore,
}

impl Default for PruneSettings {
    /// The paper's ablations use 0.4, after 20,000 of 30,000 steps.
    fn default() -> Self {
        Self { ratio: 0.4, at: 2.0 / 3.0, score: PruneScore::default() }
    }
}

/// Where a training looks from.
#[derive(Clone, Debug, Default)]
pub struct TrainingViews {
    /// The cameras trained on.
    pub cameras: Vec<Camera>,
    /// Which of them may be compared.
    pub neighbours: Neighbours,
}

/// What a step learns from.
#[derive(Clone, Copy, Debug)]
pub struct Example<'a> {
    /// Index of the view.
    pub view: usize,
    /// Its photograph, or a teacher's rendering.
    pub rgb: TargetRgb<'a>,
    /// The view of [`Trainer::neighbour_index`], where it names one, and its colours.
    pub neighbour: Option<(usize, TargetRgb<'a>)>,
}

/// What a training is told.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrainSettings {
    /// When what happens.
    pub schedule: Schedule,
    /// Scene extent: 1.1 × the largest distance of a camera from their mean, world units.
    pub extent: f64,
    /// Stored SH degree.
    pub sh_degree: u32,
    /// How the surface is trained; `None` for colour only.
    pub surface: Option<SurfaceSettings>,
    /// How the model is pruned; `None` for not at all.
    pub prune: Option<PruneSettings>,
    /// Whether each photograph has an exposure of its own.
    pub exposure: bool,
    /// Views that must observe a splat for it to stay (PGSR: 2). Fewer where the model is one of several: what a
    /// single view of it observes, views of the others may observe as well.
    pub observers_min: u32,
    /// Most splats that refinement may make; the backend's capacity bounds it as well.
    pub splats_max: usize,
    /// Seed of every random choice.
    pub seed: u64,
}

/// What a step did.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StepOutcome {
    /// The loss of the colours before the step.
    pub loss: PhotometricLoss,
    /// The losses of the surface before the step, zero where they did not count.
    pub surface: SurfaceLoss,
    /// What was blended.
    pub counts: BinCounts,
}

/// Trains a backend's splats.
///
/// ```
/// use cosurf_engine::backend::{Channels, TargetRgb};
/// use cosurf_engine::{
///     Backend, Capacity, CpuBackend, Example, Neighbours, Schedule, TrainSettings, Trainer, TrainingViews,
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
    steps_done: u32,
    splats_at_start: usize,
}

/// How far a training has come; with what [`Trainer::export`] visits, this is a checkpoint.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Progress {
    /// Steps done.
    pub steps_done: u32,
    /// Splats there were at step 0.
    pub splats_at_start: usize,
    /// Splats there are now.
    pub splats: usize,
}

impl<B: Backend> Trainer<B> {
    /// Begins with what the backend holds.
    pub fn new(backend: B, settings: TrainSettings, views: TrainingViews) -> Self {
        let haste = settings.schedule.exposure_haste();
        let exposures = settings.exposure.then(|| Exposures::new(views.cameras.len(), haste));
        let splats_at_start = backend.len();
        Self { backend, settings, views, exposures, steps_done: 0, splats_at_start }
    }

    /// Steps done so far.
    pub fn steps_done(&self) -> u32 {
        self.steps_done
    }

    /// How far the training has come.
    pub fn progress(&self) -> Progress {
        let Self { steps_done, splats_at_start, .. } = *self;
        Progress { steps_done, splats_at_start, splats: self.backend.len() }
    }

    /// Visits everything that the training has learnt, in a fixed order, in pieces. Stops at the first error.
    pub fn export<E>(&self, mut visit: impl FnMut(&[f32]) -> Result<(), E>) -> Result<(), E> {
        self.backend.export(&mut visit)?;
        self.exposures.iter().try_for_each(|exposures| exposures.export(&mut visit))
    }

    /// Goes on from where a training with the same settings was: `fill` is called with the pieces that
    /// [`Trainer::export`] visited there. Panics beyond the backend's capacity.
    pub fn import<E>(
        &mut self,
        progress: Progress,
        mut fill: impl FnMut(&mut [f32]) -> Result<(), E>,
    ) -> Result<(), E> {
        (self.steps_done, self.splats_at_start) = (progress.steps_done, progress.splats_at_start);
        self.backend.import(progress.splats, &mut fill)?;
        self.exposures.iter_mut().try_for_each(|exposures| exposures.import(&mut fill))
    }

    /// Whether all steps are done.
    pub fn is_done(&self) -> bool {
        self.steps_done >= self.settings.schedule.steps
    }

    /// What holds the splats.
    pub fn backend(&self) -> &B {
        &self.backend
    }

    /// Gives the backend back.
    pub fn into_backend(self) -> B {
        self.backend
    }

    /// The cameras trained on.
    pub fn cameras(&self) -> &[Camera] {
        &self.views.cameras
    }

    /// Which view the step after `ahead` more steps learns from: every epoch is a new order of all views.
    pub fn view_index(&self, ahead: u32) -> usize {
        let views = self.views.cameras.len();
        let step = u64::from(self.steps_done + ahead);
        let (epoch, place) = (step / views as u64, step % views as u64);
        view_order(self.settings.seed, epoch, views)[place as usize]
    }

    /// Which view the step after `ahead` more steps compares `view` with, if it does.
    pub fn neighbour_index(&self, view: usize, ahead: u32) -> Option<usize> {
        let step = self.steps_done + ahead;
        self.settings.surface?;
        self.settings.schedule.surface_ramp(step)?;
        self.views.neighbours.draw(view, self.settings.seed, step)
    }

    /// One step: learns from one view, and refines when the schedule says so.
    pub fn step(&mut self, example: &Example) -> StepOutcome {
        let TrainSettings { schedule, sh_degree, .. } = self.settings;
        let step = self.steps_done;
        let degree = schedule.sh_degree(step, sh_degree);
        let (weights, rates) = (self.weights(step), self.rates(step));
        let channels = if weights.surface.is_some() { Channels::Geometry } else { Channels::Color };
        let (backend, cameras) = (&mut self.backend, &self.views.cameras);
        if let (Some(_), Some((neighbour, _))) = (weights.surface, example.neighbour) {
            backend.project(&cameras[neighbour], 0);
            backend.bin();
            backend.rasterize(Channels::Geometry);
            backend.keep_neighbour();
        }
        backend.project(&cameras[example.view], degree);
        let counts = backend.bin();
        backend.rasterize(channels);
        let losses = backend.losses(&targets(example, self.exposures.as_ref()), &weights);
        backend.rasterize_backward();
        backend.project_backward();
        backend.adam(&rates);
        if let Some(exposures) = &mut self.exposures {
            exposures.learn(example.view, &losses.color, schedule.exposes(step));
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

    /// What counts how much at a step.
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
                    draw: Random::new(seed, Purpose::Sample, u64::from(step), 0).next_u64(),
                }),
            }
        });
        LossWeights { ssim: SSIM_WEIGHT, scale, surface, teacher: None }
    }

    /// How fast what learns at a step.
    fn rates(&self, step: u32) -> AdamRates {
        let TrainSettings { schedule, extent, surface, .. } = self.settings;
        let rates = schedule.rates(step, extent);
        // Nothing but colours would turn and stretch the splats any more.
        let shaped = surface.is_some() && step >= schedule.surface_until;
        if shaped { AdamRates { quat: 0.0, log_scale: 0.0, ..rates } } else { rates }
    }

    fn prune(&mut self, settings: &PruneSettings) {
        let scores = prune::survey(&mut self.backend, &self.views.cameras);
        let importance = prune::importance_by(&self.backend.take_shapes(), &scores, settings.score);
        self.remove(prune::lowest(&importance, settings.ratio));
    }

    fn remove(&mut self, deaths: Vec<u32>) {
        self.backend.edit(&Edit { births: Vec::new(), deaths });
    }

    fn refine(&mut self) {
        let TrainSettings { schedule, extent, splats_max, seed, .. } = self.settings;
        // Growth is spread over the whole time of refinement, so that early splats learn before they divide.
        let end = splats_max.min(self.backend.capacity());
        let room = end.saturating_sub(self.splats_at_start) as f64 * schedule.growth(self.steps_done);
        let limits = RefineLimits {
            splats_max: end.min(self.splats_at_start + room as usize),
            extent,
            prune_large: schedule.reset_every > 0 && self.steps_done > schedule.reset_every,
            seed,
            step: self.steps_done,
        };
        let shapes = self.backend.take_shapes();
        self.backend.edit(&refine(&shapes, &limits));
    }
}

/// What an example's rendering should look like.
fn targets<'a>(example: &Example<'a>, exposures: Option<&Exposures>) -> Targets<'a> {
    Targets {
        exposure: exposures.map_or_else(Exposure::default, |exposures| exposures.of(example.view)),
        neighbour_rgb: example.neighbour.map(|(_, rgb)| rgb),
        ..Targets::colors(example.rgb)
    }
}

/// A permutation of the views (Fisher–Yates), one for each epoch.
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
