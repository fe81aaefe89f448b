//! Distillation: a model is trained on renderings of other models instead of photographs (CoSurfGS, "Model Aggregation
//! Scheme"). No splats are added. At the end, the useless splats are reported.

use cosurf_scene::{Camera, Splats, camera};
use tracing::trace_span;

use crate::backend::{
    AdamRates, Backend, BinCounts, Channels, LossWeights, Losses, SurfaceWeights, TargetRgb, TargetSurface,
    Targets, TeacherWeights,
};
use crate::prune;
use crate::train::SSIM_WEIGHT;

/// Settings of a distillation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DistillSettings {
    /// Number of steps.
    pub steps: u32,
    /// Number of steps of the cooldown at the end. During these, all learning rates except that of means are divided by
    /// ten.
    pub cooldown_steps: u32,
    /// Learning rates before the cooldown.
    pub rates: StudentRates,
    /// Scene extent: 1.1 × the largest distance of a camera from the mean position of all cameras, world units.
    pub extent: f64,
    /// Median depth of the teachers' renderings, world units.
    pub depth: f64,
    /// SH degree of the model.
    pub sh_degree: u32,
}

impl DistillSettings {
    /// No mean moves farther than this during the distillation, along any axis, world units.
    pub fn reach(&self) -> f64 {
        let fall = libm::pow(MEAN_RATE_FALL, 1.0 / f64::from(self.steps.max(1)));
        let sum_of_rates = self.rates.mean * self.extent * (1.0 - MEAN_RATE_FALL) / (1.0 - fall);
        STEP_MAX * sum_of_rates
    }
}

/// The target of one step: a teacher's rendering.
#[derive(Clone, Copy, Debug)]
pub struct Lesson<'a> {
    /// Camera of the rendering.
    pub camera: &'a Camera,
    /// The rendering shows only splats whose centres lie up to this depth along the optical axis, world units.
    pub far: f64,
    /// Colours, `[height, width, rgb]`, 0 and up.
    pub rgb: &'a [f32],
    /// Depths, normals, and the weight of each pixel.
    pub surface: TargetSurface<'a>,
}

/// Weight λ₁ of the mean shortest scale (CoSurfGS). It is divided by the scene extent, so that the unit of length does
/// not matter.
const SCALE_WEIGHT: f64 = 100.0;
/// Weight β₂ of the single-view normal loss (CoSurfGS).
const NORMAL_WEIGHT: f32 = 0.01;
/// Weight of `L_d`, the difference of depths from the teacher (CoSurfGS). It is divided by the median depth, so that
/// the unit of length does not matter.
const DEPTH_WEIGHT: f64 = 0.015;
/// Weight of `L_n`, the difference of blended normals from the teacher (CoSurfGS).
const TEACHER_NORMAL_WEIGHT: f32 = 0.015;

/// Learning rates of a student, the model that is trained. They are as in [`AdamRates`], except for the rate of means:
/// it is multiplied by the scene extent, and falls log-linearly to a hundredth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StudentRates {
    /// Rate of means at the first step, for a scene extent of 1.
    pub mean: f64,
    /// Rate of quaternions.
    pub quat: f32,
    /// Rate of log scales.
    pub log_scale: f32,
    /// Rate of opacity logits.
    pub opacity: f32,
    /// Rate of the constant colour term. The rate of the other SH coefficients is a share of it: [`SH_REST_SHARE`].
    pub sh_dc: f32,
}

impl StudentRates {
    /// Learning rates for distilling a trained model. The rate of means is that of 3DGS divided by ten (DOGS). That of
    /// opacities is 0.6 of that of 3DGS, and the others are 1.5 times those of 3DGS. With two thirds of these rates,
    /// rendered Boruszyn has 34.46 dB after 5 epochs instead of 34.51, and 34.55 after 7; Caliterra has the same.
    pub const TRAINED: Self =
        Self { mean: 1.6e-5, quat: 0.0015, log_scale: 0.0075, opacity: 0.03, sh_dc: 0.00375 };
}

/// Rate of the SH coefficients except the constant one, as a share of its rate. 3DGS has a twentieth, for trainings of many more
/// steps. A fifth gives 0.05 dB more on two halves of Caliterra, every other picture in each, 0.04 on four agents there, and
/// 0.03 on rendered Boruszyn; two fifths give less than a fifth.
const SH_REST_SHARE: f32 = 0.2;

/// Share of its first value to which the rate of means falls, log-linearly over all steps (3DGS).
const MEAN_RATE_FALL: f64 = 0.01;

/// Bound on a step of Adam, in learning rates: `(1 - β₁) / √((1 - β₂) (1 - β₁² / β₂))` is 7.27. It is doubled, because
/// rounding makes a step at most twice as long.
const STEP_MAX: f64 = 14.6;

/// Factor on all learning rates except that of means during the cooldown.
const COOLED: f32 = 0.1;

/// Opacity below which a splat is useless (3DGS).
const OPACITY_MIN: f32 = 0.005;
/// Scale above which a splat is useless, as a share of the scene extent. The limit of 3DGS, a tenth, would remove
/// ground without texture, which distillation cannot fill again.
const SCALE_MAX: f64 = 1.0;

/// Alpha above which the depth and normal of a teacher's pixel count in the losses. The colours of a teacher always
/// count: they match the photograph even where the surface is uncertain.
pub const TRUSTED_ALPHA_MIN: f32 = 0.95;

/// The scene extent of `cameras`, for [`DistillSettings::extent`]. It is 1 if all cameras are in one place, so that it
/// is always above 0.
pub fn extent(cameras: &[Camera]) -> f64 {
    let reach = camera::extent(cameras.iter());
    if reach > 0.0 { reach } else { 1.0 }
}

/// The median of the depths that teachers rendered, for [`DistillSettings::depth`]. Depths of 0 mean no surface and are
/// left out; if none remain, the result is 1.
pub fn median_depth(depths: impl Iterator<Item = f32>) -> f64 {
    let mut depths: Vec<f32> = depths.filter(|depth| *depth > 0.0).collect();
    depths.sort_unstable_by(f32::total_cmp);
    depths.get(depths.len() / 2).map_or(1.0, |depth| f64::from(*depth))
}

/// Trains the splats of a backend on renderings of teachers.
pub struct Distiller<B> {
    backend: B,
    settings: DistillSettings,
    steps_done: u32,
}

impl<B: Backend> Distiller<B> {
    /// Starts with the splats that the backend holds.
    pub fn new(backend: B, settings: DistillSettings) -> Self {
        Self { backend, settings, steps_done: 0 }
    }

    /// Trains one step on one rendering. Returns the losses before the step, and the counts of the binning pass.
    pub fn step(&mut self, lesson: &Lesson) -> (Losses, BinCounts) {
        let _span = trace_span!("step", step = self.steps_done).entered();
        let weights = self.weights();
        let rates = self.rates();
        let backend = &mut self.backend;
        backend.project_up_to(lesson.camera, self.settings.sh_degree, lesson.far);
        backend.bin();
        backend.rasterize(Channels::Geometry);
        let targets =
            Targets { surface: Some(lesson.surface), ..Targets::colors(TargetRgb::Floats(lesson.rgb)) };
        let losses = backend.losses(&targets, &weights);
        let counts = backend.counts();
        backend.rasterize_backward();
        backend.project_backward();
        backend.adam(&rates);
        self.steps_done += 1;
        (losses, counts)
    }

    /// The trained model, including useless splats.
    pub fn into_splats(self) -> Splats {
        self.backend.into_splats()
    }

    /// The trained model, and the indices (ascending) of the useless ones among its first `first` splats. A splat is
    /// useless if it is transparent, huge, or invisible to all of `cameras`.
    pub fn finish<'a>(
        mut self,
        cameras: impl IntoIterator<Item = &'a Camera>,
        first: usize,
    ) -> (Splats, Vec<u32>) {
        let hits = prune::hits(&mut self.backend, cameras, first);
        let scale_max = (SCALE_MAX * self.settings.extent) as f32;
        let splats = self.backend.into_splats();
        let useless = prune::useless(&splats, &hits[..first], OPACITY_MIN, scale_max);
        (splats, useless)
    }

    fn weights(&self) -> LossWeights {
        let DistillSettings { extent, depth, .. } = self.settings;
        LossWeights {
            ssim: SSIM_WEIGHT,
            scale: (SCALE_WEIGHT / extent) as f32,
            surface: Some(SurfaceWeights { normal: NORMAL_WEIGHT, multiview: None }),
            teacher: Some(TeacherWeights {
                depth: (DEPTH_WEIGHT / depth) as f32,
                normal: TEACHER_NORMAL_WEIGHT,
            }),
        }
    }

    fn rates(&self) -> AdamRates {
        let DistillSettings { steps, cooldown_steps, rates, extent, .. } = self.settings;
        let share = if self.steps_done + cooldown_steps >= steps { COOLED } else { 1.0 };
        let progress = f64::from(self.steps_done) / f64::from(steps.max(1));
        AdamRates {
            mean: (rates.mean * libm::pow(MEAN_RATE_FALL, progress) * extent) as f32,
            quat: share * rates.quat,
            log_scale: share * rates.log_scale,
            opacity: share * rates.opacity,
            sh_dc: share * rates.sh_dc,
            sh_rest: share * SH_REST_SHARE * rates.sh_dc,
            first_correction: 1.0,
            second_correction: 1.0,
        }
        .at_step(self.steps_done + 1)
    }
}
