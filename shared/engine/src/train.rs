//! Training: one step reads as its list of passes.

use cosurf_scene::Camera;

use crate::backend::{
    Backend, BinCounts, Channels, Edit, LossWeights, PhotometricLoss, Scores, SurfaceLoss, SurfaceWeights,
    TargetRgb, Targets,
};
use crate::neighbours::Neighbours;
use crate::prune::{self, PruneScore};
use crate::random::{Purpose, Random};
use crate::refine::{RefineLimits, refine};
use crate::schedule::Schedule;

/// Weight of `1 - SSIM` (3DGS).
const SSIM_WEIGHT: f32 = 0.2;
/// Opacity after a reset (3DGS).
const RESET_OPACITY: f32 = 0.01;

/// How the surface is trained (CoSurfGS, "Device-side Training Procedure").
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfaceSettings {
    /// λ₁: weight of the mean shortest scale, as a share of the scene's extent.
    pub scale: f32,
    /// β₂: weight of the single-view normal loss at the end of an endless ramp.
    pub normal: f32,
    /// Of the reprojection error.
    pub reprojection: f32,
    /// Of `1 - NCC²`.
    pub ncc: f32,
    /// Whether the weights grow from nothing (the paper's smooth weight) or are what they are from the start.
    pub smooth: bool,
    /// One pixel in each square of this side is compared with the neighbour: 1, 2, 4, 8 or 16 px.
    pub cell_px: u32,
}

impl Default for SurfaceSettings {
    fn default() -> Self {
        Self { scale: 100.0, normal: 0.01, reprojection: 0.05, ncc: 0.2, smooth: true, cell_px: 4 }
    }
}

/// Adaptive Gaussian Pruning (CoSurfGS).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PruneSettings {
    /// φ: share of the splats that go, 0..1.
    pub ratio: f64,
    /// What decides.
    pub score: PruneScore,
}

impl Default for PruneSettings {
    /// The paper's ablations use 0.4.
    fn default() -> Self {
        Self { ratio: 0.4, score: PruneScore::default() }
    }
}

/// Where a training looks from.
#[derive(Clone, Debug, Default)]
pub struct Flight {
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
pub struct Trainer<B> {
    backend: B,
    settings: TrainSettings,
    flight: Flight,
    steps_done: u32,
    splats_at_start: usize,
}

impl<B: Backend> Trainer<B> {
    /// Goes on after `steps_done` steps with what the backend holds; `splats_at_start` is how many splats there
    /// were at step 0.
    pub fn new(
        backend: B,
        settings: TrainSettings,
        flight: Flight,
        steps_done: u32,
        splats_at_start: usize,
    ) -> Self {
        Self { backend, settings, flight, steps_done, splats_at_start }
    }

    /// Steps done so far.
    pub fn steps_done(&self) -> u32 {
        self.steps_done
    }

    /// How many splats there were at step 0.
    pub fn splats_at_start(&self) -> usize {
        self.splats_at_start
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
        &self.flight.cameras
    }

    /// Which view the step after `ahead` more steps learns from: every epoch is a new order of all views.
    pub fn view_index(&self, ahead: u32) -> usize {
        let views = self.flight.cameras.len();
        let step = u64::from(self.steps_done + ahead);
        let (epoch, place) = (step / views as u64, step % views as u64);
        view_order(self.settings.seed, epoch, views)[place as usize]
    }

    /// Which view the step after `ahead` more steps compares `view` with, if it does.
    pub fn neighbour_index(&self, view: usize, ahead: u32) -> Option<usize> {
        let step = self.steps_done + ahead;
        self.settings.surface?;
        self.settings.schedule.surface_ramp(step)?;
        self.flight.neighbours.draw(view, self.settings.seed, step)
    }

    /// One step: learns from one view, and refines when the schedule says so.
    pub fn step(&mut self, example: &Example) -> StepOutcome {
        let TrainSettings { schedule, extent, sh_degree, .. } = self.settings;
        let step = self.steps_done;
        let degree = schedule.sh_degree(step, sh_degree);
        let weights = self.weights(step);
        let channels = if weights.surface.is_some() { Channels::Geometry } else { Channels::Color };
        let (backend, cameras) = (&mut self.backend, &self.flight.cameras);
        if let (Some(_), Some((neighbour, _))) = (weights.surface, example.neighbour) {
            backend.project(&cameras[neighbour], 0);
            backend.bin();
            backend.rasterize(Channels::Geometry);
            backend.keep_neighbour();
        }
        backend.project(&cameras[example.view], degree);
        let counts = backend.bin();
        backend.rasterize(channels);
        let neighbour_rgb = example.neighbour.map(|(_, rgb)| rgb);
        let losses = backend.losses(&Targets { rgb: example.rgb, neighbour_rgb }, &weights);
        backend.rasterize_backward();
        backend.project_backward();
        backend.adam(&schedule.rates(step, extent));
        self.steps_done += 1;
        if schedule.refines_after(self.steps_done) {
            self.refine();
        }
        if schedule.observes_after(self.steps_done, self.flight.cameras.len()) {
            let scores = self.survey();
            self.remove(prune::unobserved(&scores));
        }
        if let Some(settings) = self.settings.prune.filter(|_| self.steps_done == schedule.prune_at) {
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
                reprojection: ramp * surface.reprojection,
                ncc: ramp * surface.ncc,
                cell_px: surface.cell_px,
                draw: Random::new(seed, Purpose::Sample, u64::from(step), 0).next_u64(),
            }
        });
        LossWeights { ssim: SSIM_WEIGHT, scale, surface }
    }

    /// What every splat gives to all views together.
    fn survey(&mut self) -> Scores {
        self.backend.clear_scores();
        for camera in &self.flight.cameras {
            self.backend.project(camera, 0);
            self.backend.bin();
            self.backend.rasterize(Channels::Color);
            self.backend.score();
        }
        self.backend.scores()
    }

    fn prune(&mut self, settings: &PruneSettings) {
        let scores = self.survey();
        let priorities = prune::priorities(&self.backend.take_shapes(), &scores, settings.score);
        self.remove(prune::lowest(&priorities, settings.ratio));
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

/// A permutation of the views (Fisher–Yates), one for each epoch.
fn view_order(seed: u64, epoch: u64, views: usize) -> Vec<usize> {
    let mut random = Random::new(seed, Purpose::ViewOrder, epoch, 0);
    let mut order: Vec<usize> = (0..views).collect();
    for last in (1..views).rev() {
        order.swap(last, random.below(last as u64 + 1) as usize);
    }
    order
}
