//! Distillation: a model learns from what other models show instead of from photographs (CoSurfGS, "Model
//! Aggregation Scheme"). No splat is born; at the end those that give nothing go.

use cosurf_scene::{Camera, Splats, camera};

use crate::backend::{
    AdamRates, Backend, BinCounts, Channels, LossWeights, Losses, SurfaceWeights, TargetRgb, TargetSurface,
    Targets, TeacherWeights,
};
use crate::prune;
use crate::train::SSIM_WEIGHT;

/// What a distillation is told.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DistillSettings {
    /// Steps in all.
    pub steps: u32,
    /// Steps at the end in which everything moves ten times less.
    pub cooldown_steps: u32,
    /// How fast it learns until then.
    pub rates: StudentRates,
    /// Scene extent: 1.1 × the largest distance of a camera from their mean, world units.
    pub extent: f64,
    /// Median depth of what the cameras see, world units.
    pub depth: f64,
    /// SH degree of the model.
    pub sh_degree: u32,
}

/// What a step learns from: a teacher's rendering.
#[derive(Clone, Copy, Debug)]
pub struct Lesson<'a> {
    /// Where it was rendered.
    pub camera: &'a Camera,
    /// `[height, width, rgb]`, 0 and up.
    pub rgb: &'a [f32],
    /// Depth, normals, and how far they are to be believed.
    pub surface: TargetSurface<'a>,
}

/// λ₁ and β₂ of training (CoSurfGS), for the mean shortest scale and the single-view normals.
const SCALE_WEIGHT: f64 = 100.0;
const NORMAL_WEIGHT: f32 = 0.01;
/// Weights of `L_d`, in median depths, and of `L_n` (CoSurfGS).
const DEPTH_WEIGHT: f64 = 0.015;
const TEACHER_NORMAL_WEIGHT: f32 = 0.015;

/// How fast a student learns; [`AdamRates`] but for the mean's, which is per world unit of extent and falls
/// log-linearly to a hundredth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StudentRates {
    /// Of means.
    pub mean: f64,
    /// Of quaternions.
    pub quat: f32,
    /// Of log scales.
    pub log_scale: f32,
    /// Of opacity logits.
    pub opacity: f32,
    /// Of the constant colour term; that of the others is a twentieth.
    pub sh_dc: f32,
}

impl StudentRates {
    /// Of a model that others have trained: those of 3DGS, a tenth of it for means (DOGS).
    pub const TRAINED: Self =
        Self { mean: 1.6e-5, quat: 0.001, log_scale: 0.005, opacity: 0.05, sh_dc: 0.0025 };
}

const MEAN_RATE_FALL: f64 = 0.01;

/// Share of the rates that is left at the end.
const COOLED: f32 = 0.1;

/// Opacity below which a splat goes at the end (3DGS).
const OPACITY_MIN: f32 = 0.005;
/// Largest scale that stays, as a share of the extent. 3DGS's tenth takes away ground without texture, which nothing
/// comes to fill any more: 31.2 instead of 33.3 dB held out (real drone pictures, Caliterra at 240 px).
const SCALE_MAX: f64 = 1.0;

/// A surface of a teacher that shows less than this is not believed. Colours are believed everywhere: a teacher's picture
/// is that of the photograph even where its surface is not, and leaving out what is not opaque costs 0.7 dB (real drone
/// pictures, Caliterra at 240 px: 32.65 instead of 33.31 dB held out).
pub const TRUSTED_ALPHA_MIN: f32 = 0.95;

/// [`DistillSettings::extent`] of what `cameras` see, above 0.
pub fn extent(cameras: &[Camera]) -> f64 {
    let reach = camera::extent(cameras.iter());
    if reach > 0.0 { reach } else { 1.0 }
}

/// [`DistillSettings::depth`] of a teacher's depths, of which 0 is none.
pub fn median_depth(depths: impl Iterator<Item = f32>) -> f64 {
    let mut depths: Vec<f32> = depths.filter(|depth| *depth > 0.0).collect();
    depths.sort_unstable_by(f32::total_cmp);
    depths.get(depths.len() / 2).map_or(1.0, |depth| f64::from(*depth))
}

/// Distils into a backend's splats.
pub struct Distiller<B> {
    backend: B,
    settings: DistillSettings,
    steps_done: u32,
}

impl<B: Backend> Distiller<B> {
    /// Begins with what the backend holds.
    pub fn new(backend: B, settings: DistillSettings) -> Self {
        Self { backend, settings, steps_done: 0 }
    }

    /// One step: learns from one rendering.
    pub fn step(&mut self, lesson: &Lesson) -> (Losses, BinCounts) {
        let weights = self.weights();
        let rates = self.rates();
        let backend = &mut self.backend;
        backend.project(lesson.camera, self.settings.sh_degree);
        let counts = backend.bin();
        backend.rasterize(Channels::Geometry);
        let targets =
            Targets { surface: Some(lesson.surface), ..Targets::colors(TargetRgb::Floats(lesson.rgb)) };
        let losses = backend.losses(&targets, &weights);
        backend.rasterize_backward();
        backend.project_backward();
        backend.adam(&rates);
        self.steps_done += 1;
        (losses, counts)
    }

    /// The model, all of it.
    pub fn into_splats(self) -> Splats {
        self.backend.splats()
    }

    /// The model, and the indices (ascending) of those of its splats that are transparent, huge, or give nothing to
    /// any of `cameras`.
    pub fn finish<'a>(mut self, cameras: impl IntoIterator<Item = &'a Camera>) -> (Splats, Vec<u32>) {
        let scores = prune::survey(&mut self.backend, cameras);
        let shapes = self.backend.take_shapes();
        let scale_max = (SCALE_MAX * self.settings.extent) as f32;
        (self.backend.splats(), prune::useless(&shapes, &scores, OPACITY_MIN, scale_max))
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
            mean: (rates.mean * MEAN_RATE_FALL.powf(progress) * extent) as f32,
            quat: share * rates.quat,
            log_scale: share * rates.log_scale,
            opacity: share * rates.opacity,
            sh_dc: share * rates.sh_dc,
            sh_rest: share * rates.sh_dc / 20.0,
            first_correction: 1.0,
            second_correction: 1.0,
        }
        .at_step(self.steps_done + 1)
    }
}
