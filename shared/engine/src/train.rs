//! Training: one step reads as its list of passes.

use cosurf_scene::Camera;

use crate::backend::{Backend, BinCounts, Channels, LossWeights, PhotometricLoss, Targets};
use crate::random::{Purpose, Random};
use crate::refine::{RefineLimits, refine};
use crate::schedule::Schedule;

/// Weight of `1 - SSIM` (3DGS).
const SSIM_WEIGHT: f32 = 0.2;
/// Opacity after a reset (3DGS).
const RESET_OPACITY: f32 = 0.01;

/// What a training is told.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrainSettings {
    /// When what happens.
    pub schedule: Schedule,
    /// Scene extent: 1.1 × the largest distance of a camera from their mean, world units.
    pub extent: f64,
    /// Stored SH degree.
    pub sh_degree: u32,
    /// Most splats that refinement may make; the backend's capacity bounds it as well.
    pub splats_max: usize,
    /// Seed of every random choice.
    pub seed: u64,
}

/// What a step did.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StepOutcome {
    /// The loss before the step.
    pub loss: PhotometricLoss,
    /// What was blended.
    pub counts: BinCounts,
}

/// Trains a backend's splats.
pub struct Trainer<B> {
    backend: B,
    settings: TrainSettings,
    steps_done: u32,
    splats_at_start: usize,
}

impl<B: Backend> Trainer<B> {
    /// Goes on after `steps_done` steps with what the backend holds; `splats_at_start` is how many splats there
    /// were at step 0.
    pub fn new(backend: B, settings: TrainSettings, steps_done: u32, splats_at_start: usize) -> Self {
        Self { backend, settings, steps_done, splats_at_start }
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

    /// Which of `views` the step after `ahead` more steps learns from: every epoch is a new order of all views.
    pub fn view_index(&self, views: usize, ahead: u32) -> usize {
        let step = u64::from(self.steps_done + ahead);
        let (epoch, place) = (step / views as u64, step % views as u64);
        view_order(self.settings.seed, epoch, views)[place as usize]
    }

    /// One step: learns from one view, and refines when the schedule says so.
    pub fn step(&mut self, camera: &Camera, targets: &Targets) -> StepOutcome {
        let TrainSettings { schedule, extent, sh_degree, .. } = self.settings;
        let step = self.steps_done;
        let backend = &mut self.backend;
        backend.project(camera, schedule.sh_degree(step, sh_degree));
        let counts = backend.bin();
        backend.rasterize(Channels::Color);
        let loss = backend.losses(targets, &LossWeights { ssim: SSIM_WEIGHT });
        backend.rasterize_backward();
        backend.project_backward();
        backend.adam(&schedule.rates(step, extent));
        self.steps_done += 1;
        if schedule.refines_after(self.steps_done) {
            self.refine();
        }
        if schedule.resets_after(self.steps_done) {
            self.backend.cap_opacity(RESET_OPACITY);
        }
        StepOutcome { loss, counts }
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
