//! The schedule of a training, scaled to its number of steps. A run of 600 steps thus goes through the same phases as
//! one of 30,000; only opacity resets are left out in short runs.
//!
//! Pictures have their full size in every step. Smaller pictures in the first steps were tried, and are no better than fewer
//! steps. Measured on Caliterra at 640 px, two cores: 600 steps, of which 30 % at a quarter of the size and then 50 % at half
//! of it, take 59 s and reach 32.20 dB and an SSIM of 0.903; 430 steps at full size take 55 s and reach 32.15 dB and 0.911.
//!
//! Refinements end after half of the steps, as in 3DGS. If they end after 35, 40, 50, 60 or 70 % of 600 steps, rendered
//! Boruszyn has 34.6, 34.8, 34.8, 34.7 or 34.3 dB. If they end after 40, 50 or 60 % of 1,500 steps, Caliterra has 33.4, 34.3 or
//! 33.7 dB; at 40 % it has 66,000 splats, at 50 % 92,000. All at 320 px.

use crate::backend::AdamRates;

/// Learning rate of means at the first step, for a scene extent of 1 world unit (3DGS).
const MEAN_RATE: f64 = 1.6e-4;
/// The learning rate of means falls log-linearly over all steps, to this share of its first value (3DGS).
const MEAN_RATE_FALL: f64 = 0.01;
/// Learning rates of the other parameters (3DGS).
const QUAT_RATE: f64 = 0.001;
const LOG_SCALE_RATE: f64 = 0.005;
const OPACITY_RATE: f64 = 0.05;
const SH_DC_RATE: f64 = 0.0025;
const SH_REST_RATE: f64 = SH_DC_RATE / 20.0;

/// Shorter runs need higher rates: with the rates of 3DGS, scales do not grow in time to close the gaps between sparse
/// points. A rate is multiplied by `REFERENCE_STEPS / steps` to a power, which this and the next three constants give.
/// Opacity and constant colour gain nothing from higher rates.
const MEAN_HASTE: f64 = 0.29;
const QUAT_HASTE: f64 = 0.41;
const LOG_SCALE_HASTE: f64 = 0.46;
const SH_REST_HASTE: f64 = 0.35;

/// Share of the steps after which the cooldown begins, in which all rates except that of means fall log-linearly.
const COOLDOWN_FROM: f64 = 0.8;
/// Share of their value to which the rates fall during the cooldown.
const COOLDOWN_FALL: f64 = 0.1;

/// Number of steps of a 3DGS training. The learning rates above are tuned for it. Below, step numbers from the papers
/// are divided by it to become shares of a run.
const REFERENCE_STEPS: f64 = 30_000.0;

/// Share of the steps before the surface losses begin (CoSurfGS: 7,000 of 30,000).
const SURFACE_FROM: f64 = 7000.0 / 30_000.0;
/// Share of the steps after which the surface losses end. From then on splats keep their rotations and scales, and
/// colours adapt to the final surface.
const SURFACE_UNTIL: f64 = 0.85;

/// Share of the steps before exposures are trained (PGSR: 1,000 of 30,000).
const EXPOSURE_FROM: f64 = 1000.0 / 30_000.0;
/// Shorter runs train exposures with a higher rate: it is multiplied by `REFERENCE_STEPS / steps` to this power.
const EXPOSURE_HASTE: f64 = 0.41;

/// Share of the steps before poses are measured: until then, splats grow from points to a picture.
const POSES_FROM: f64 = 0.06;
/// Share of the steps after which it is known at the earliest whether poses are exact.
const POSES_KNOWN: f64 = 0.12;
/// Share of the steps after which poses are learnt in fine blocks.
const POSES_FINE: f64 = 0.3;
/// Share of the steps after which poses stay as they are.
const POSES_UNTIL: f64 = 0.85;

/// Runs with fewer steps per view than this do not look for unobserved splats, which costs half a step per view.
const OBSERVED_STEPS_PER_VIEW: usize = 10;

/// The schedule of a training.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Schedule {
    /// Steps in all.
    pub steps: u32,
    /// Steps between increases of the SH degree in use.
    pub sh_every: u32,
    /// Number of steps before the first refinement, which adds and removes splats.
    pub refine_from: u32,
    /// Number of steps after which the last refinement may follow.
    pub refine_until: u32,
    /// Steps between refinements.
    pub refine_every: u32,
    /// Steps between opacity resets; 0 for none.
    pub reset_every: u32,
    /// First step (counted from 0) with surface losses.
    pub surface_from: u32,
    /// First step (counted from 0) after the end of the surface losses.
    pub surface_until: u32,
}

impl Schedule {
    /// The schedule for a number of steps.
    pub fn new(steps: u32) -> Self {
        let refine_every = (steps / 30).clamp(20, 100);
        Self {
            steps,
            sh_every: (steps / 8).clamp(1, 1000),
            refine_from: (steps / 12).clamp(refine_every, 500),
            refine_until: steps / 2,
            refine_every,
            // Recovery from a reset takes a few thousand steps, too many for shorter runs.
            reset_every: if steps >= 10_000 { 3000 } else { 0 },
            surface_from: (f64::from(steps) * SURFACE_FROM) as u32,
            surface_until: (f64::from(steps) * SURFACE_UNTIL) as u32,
        }
    }

    /// SH degree in use at a step (counted from 0), at most the degree `stored` of the model.
    pub fn sh_degree(&self, step: u32, stored: u32) -> u32 {
        (step / self.sh_every).min(stored)
    }

    /// Whether a refinement follows after this many steps.
    pub fn refines_after(&self, steps_done: u32) -> bool {
        steps_done >= self.refine_from
            && steps_done <= self.refine_until
            && steps_done.is_multiple_of(self.refine_every)
    }

    /// Whether opacities are lowered after this many steps.
    pub fn resets_after(&self, steps_done: u32) -> bool {
        self.reset_every > 0
            && steps_done < self.refine_until
            && steps_done.is_multiple_of(self.reset_every)
            && steps_done > 0
    }

    /// Whether splats that too few of `views` views observe are removed after this many steps. Long enough runs remove
    /// them twice: in the middle and at the end of the time in which refinements happen.
    pub fn observes_after(&self, steps_done: u32, views: usize) -> bool {
        let span = self.refine_until.saturating_sub(self.refine_from);
        self.steps as usize >= OBSERVED_STEPS_PER_VIEW * views
            && [self.refine_from + span / 2, self.refine_until].contains(&steps_done)
    }

    /// Whether exactly this share (0..=1) of the steps is done, rounded down to a whole step.
    pub(crate) fn is_at(&self, share: f64, steps_done: u32) -> bool {
        steps_done == (f64::from(self.steps) * share) as u32
    }

    /// Share of the growth of the model that is allowed after this many steps, 0..=1. It rises linearly from the first
    /// to the last refinement.
    pub fn growth(&self, steps_done: u32) -> f64 {
        let span = self.refine_until.saturating_sub(self.refine_from).max(1);
        (f64::from(steps_done.saturating_sub(self.refine_from)) / f64::from(span)).clamp(0.0, 1.0)
    }

    /// The smooth weight of the surface losses at a step (counted from 0); `None` before they begin and after they end.
    /// It is `(t - τ) / T`, with t the step, τ the first step with surface losses, and T the number of all steps
    /// (CoSurfGS, "Device-side Training Procedure").
    pub fn surface_ramp(&self, step: u32) -> Option<f32> {
        let since = step.checked_sub(self.surface_from).filter(|_| step < self.surface_until)?;
        Some((f64::from(since) / f64::from(self.steps.max(1))) as f32)
    }

    /// The first steps (counted from 0) in which poses of `views` views are measured, in which it is known whether they are
    /// exact, in which they are learnt in fine blocks of pixels, and in which they stay as they are.
    pub(crate) fn pose_steps(&self, views: usize) -> [u32; 4] {
        let at = |share: f64| (f64::from(self.steps) * share) as u32;
        let looked = at(POSES_FROM).saturating_add(u32::try_from(views).unwrap_or(u32::MAX));
        let known = looked.clamp(at(POSES_KNOWN), at(POSES_FINE));
        [at(POSES_FROM), known, at(POSES_FINE).max(known), at(POSES_UNTIL)]
    }

    /// Whether exposures are trained at a step (counted from 0).
    pub fn trains_exposures(&self, step: u32) -> bool {
        f64::from(step) >= f64::from(self.steps) * EXPOSURE_FROM
    }

    /// Factor on the learning rate of exposures, at least 1. Runs as long as a 3DGS training have 1.
    pub fn exposure_haste(&self) -> f64 {
        libm::pow(self.shortness(), EXPOSURE_HASTE)
    }

    /// By which factor this run is shorter than a 3DGS training, at least 1.
    fn shortness(&self) -> f64 {
        (REFERENCE_STEPS / f64::from(self.steps.max(1))).max(1.0)
    }

    /// Learning rates of a step (counted from 0) in a scene of this extent, world units.
    pub fn rates(&self, step: u32, extent: f64) -> AdamRates {
        let progress = f64::from(step) / f64::from(self.steps.max(1));
        let mean = MEAN_RATE * libm::pow(MEAN_RATE_FALL, progress);
        let shortness = self.shortness();
        let cooldown =
            libm::pow(COOLDOWN_FALL, ((progress - COOLDOWN_FROM) / (1.0 - COOLDOWN_FROM)).max(0.0));
        let hasty = |rate: f64, haste: f64| rate * libm::pow(shortness, haste);
        let rate = |rate: f64, haste: f64| (cooldown * hasty(rate, haste)) as f32;
        AdamRates {
            mean: hasty(mean * extent, MEAN_HASTE) as f32,
            quat: rate(QUAT_RATE, QUAT_HASTE),
            log_scale: rate(LOG_SCALE_RATE, LOG_SCALE_HASTE),
            opacity: rate(OPACITY_RATE, 0.0),
            sh_dc: rate(SH_DC_RATE, 0.0),
            sh_rest: rate(SH_REST_RATE, SH_REST_HASTE),
            first_correction: 1.0,
            second_correction: 1.0,
        }
        .at_step(step + 1)
    }
}
