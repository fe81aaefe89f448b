//! A base: a third of a model's splats, trained so that together they look like the whole model. An upload sends the
//! base first, so that the receiver has a usable model wherever the link breaks off.
//!
//! The most important splats alone leave holes. A base is therefore distilled: its splats are trained on renderings of
//! the whole model, seen by the cameras of the model. The first of two stages trains the most important half of the
//! splats. The second stage trains only the most important splats of that half. Quaternions are frozen: after the base,
//! an upload sends the changes that turn base splats back into those of the model, and for quaternions these would cost
//! as much as training gains.

use std::rc::Rc;

use cosurf_scene::{Base, Camera, Splats};
use tracing::info_span;

use crate::backend::{Backend, Channels, Rendering, TargetSurface};
use crate::budget::Capacity;
use crate::cache::RenderingCache;
use crate::cpu::CpuBackend;
use crate::distill::{self, DistillSettings, Distiller, Lesson, StudentRates, TRUSTED_ALPHA_MIN};
use crate::prune;
use crate::render::Renderer;
use crate::train::view_order;

/// Share of the splats in a base. Their bytes are about a fifth of the whole upload.
const SHARE: f64 = 0.31;
/// Share of the splats that the first stage trains. If it trained all splats, few of those that fill holes would
/// survive the selection for the second stage. If it trained only as many as the base has, all would be selected by
/// their importance in the whole model, which differs from that in a base.
const SHARE_AT_FIRST: f64 = 0.5;
/// Smallest number of splats of a model that has a base. Smaller models are sent quickly as a whole.
const SPLATS_MIN: usize = 2000;
/// If one splat in k is kept, scales are multiplied by k to this power. The power is low, because important splats are
/// large already.
const GROWTH: f32 = 0.25;

/// Number of steps of each of the two stages.
const STEPS: [u32; 2] = [52, 156];
/// Number of steps with lower learning rates at the end of each stage.
const COOLDOWN_STEPS: u32 = 26;
/// Learning rates. Because the stages are short, they are multiples of those of 3DGS: 3 × for means and colours, 4 ×
/// for log scales, 2 × for opacities. They are tuned on the dataset "rendered Boruszyn".
const RATES: StudentRates =
    StudentRates { mean: 4.8e-4, quat: 0.0, log_scale: 0.02, opacity: 0.1, sh_dc: 0.0075 };

/// Trains the base of a model on the processor, with `threads` threads, at least 1. `cameras` are the cameras that the
/// model was trained with. Returns `None` if the model is small or `cameras` is empty.
///
/// Up to `kept_bytes` of memory hold renderings that later steps use again. After each step, `tell` receives the number
/// of steps done and the number of all steps. The same model and cameras always give the same base.
pub fn base_of(
    splats: &Splats,
    cameras: &[Camera],
    threads: usize,
    kept_bytes: usize,
    mut tell: impl FnMut(u32, u32),
) -> Option<Base> {
    if splats.len() < SPLATS_MIN || cameras.is_empty() {
        return None;
    }
    let _span = info_span!("base", splats = splats.len()).entered();
    let mut renderer = Renderer::new(splats, threads);
    let importance = renderer.importance(cameras);
    let mut base = keep(&of_one_color(splats), &importance, SHARE_AT_FIRST * splats.len() as f64);
    grow(&mut base.splats, splats.len());
    let mut teacher = Teacher::new(renderer, cameras, threads, kept_bytes);
    for (stage, steps) in STEPS.into_iter().enumerate() {
        if stage > 0 {
            let importance = Renderer::new(&base.splats, threads).importance(cameras);
            base = keep(&base, &importance, SHARE * splats.len() as f64);
        }
        base.splats = teacher.teach(&base.splats, steps, |step| {
            tell(STEPS[..stage].iter().sum::<u32>() + step, STEPS.iter().sum());
        });
    }
    Some(base)
}

/// A base of all splats, reduced to SH degree 0: one colour for all directions.
fn of_one_color(splats: &Splats) -> Base {
    let mut plain = Splats::with_capacity(splats.len(), 0);
    for i in 0..splats.len() {
        let (mean, quat, log_scale) = (splats.means[i], splats.quats[i], splats.log_scales[i]);
        plain.push(mean, quat, log_scale, splats.opacity_logits[i], &splats.sh_of(i)[..3]);
    }
    Base { ids: (0..splats.len() as u32).collect(), splats: plain }
}

/// Keeps the `count` most important splats; of equally important splats, the first.
fn keep(base: &Base, importance: &[f32], count: f64) -> Base {
    let gone = prune::least(importance, base.ids.len() - count as usize);
    let stays = |place: &usize| gone.binary_search(&(*place as u32)).is_err();
    let ids = (0..base.ids.len()).filter(stays).map(|place| base.ids[place]).collect();
    Base { ids, splats: base.splats.without(&gone) }
}

/// Enlarges splats that were selected from `whole` splats, so that they cover the gaps.
fn grow(splats: &mut Splats, whole: usize) {
    let growth = GROWTH * libm::logf(whole as f32 / splats.len() as f32);
    splats.log_scales.iter_mut().for_each(|log_scale| *log_scale = log_scale.map(|v| v + growth));
}

/// The whole model, which renders the targets.
struct Teacher<'a> {
    threads: usize,
    cameras: &'a [Camera],
    renderer: Renderer,
    cache: RenderingCache<usize>,
}

impl<'a> Teacher<'a> {
    fn new(renderer: Renderer, cameras: &'a [Camera], threads: usize, kept_bytes: usize) -> Self {
        Self { threads, cameras, renderer, cache: RenderingCache::new(kept_bytes as u64) }
    }

    /// Trains `student` for `steps` steps on renderings of the whole model, and returns the result. After each step,
    /// `tell` receives the number of steps done.
    fn teach(&mut self, student: &Splats, steps: u32, mut tell: impl FnMut(u32)) -> Splats {
        let room = Capacity::to_train(student, self.cameras, Channels::Geometry);
        let mut backend = CpuBackend::new(room, self.threads);
        backend.load(student);
        let settings = DistillSettings {
            steps,
            cooldown_steps: COOLDOWN_STEPS,
            rates: RATES,
            extent: distill::extent(self.cameras),
            depth: distill::median_depth(self.show(0).depth.iter().copied()),
            sh_degree: student.sh_degree,
        };
        let mut distiller = Distiller::new(backend, settings);
        let views = (0..).flat_map(|epoch| view_order(0, epoch, self.cameras.len()));
        for (done, view) in (1..).zip(views.take(steps as usize)) {
            let Rendering { rgb, alpha, depth, normal, .. } = &*self.show(view);
            let trust: Vec<f32> = alpha.iter().map(|a| f32::from(u8::from(*a > TRUSTED_ALPHA_MIN))).collect();
            let surface = TargetSurface { depth, normal, trust: &trust };
            distiller.step(&Lesson { camera: &self.cameras[view], far: f64::INFINITY, rgb, surface });
            tell(done);
        }
        distiller.into_splats()
    }

    fn show(&mut self, view: usize) -> Rc<Rendering> {
        match self.cache.get(&view) {
            Some(rendering) => rendering,
            None => self.cache.keep(view, self.renderer.render(&self.cameras[view])),
        }
    }
}

#[cfg(test)]
mod tests {
    use cosurf_scene::Pose;
    use cosurf_scene::metrics::psnr;
    use glam::{DQuat, DVec2, DVec3};

    use super::*;

    /// Flat ground of 50 × 50 splats in many colours.
    fn ground() -> Splats {
        let mut splats = Splats::with_capacity(2500, 1);
        for i in 0..2500u16 {
            let [x, y] = [i % 50, i / 50].map(|v| (f32::from(v) - 24.5) * 0.2);
            let color = [(x * 1.7).sin(), (y * 1.3).cos(), (x * y * 0.4).sin()];
            let mut sh = [0.0; 12];
            sh[..3].copy_from_slice(&color);
            splats.push([x, y, 0.0], [1.0, 0.0, 0.0, 0.0], [-2.0, -2.1, -6.0], 2.0, &sh);
        }
        splats
    }

    fn cameras() -> Vec<Camera> {
        let camera = |i: u32| Camera {
            cam_from_world: Pose {
                rotation: DQuat::from_rotation_x(std::f64::consts::PI),
                translation: DVec3::new(f64::from(i) - 2.5, 0.3 * f64::from(i % 2), 8.0),
            },
            focal_px: DVec2::splat(48.0),
            center_px: DVec2::splat(24.0),
            size_px: [48, 48],
        };
        (0..6).map(camera).collect()
    }

    fn likeness(base: &Splats, whole: &Splats) -> f64 {
        let mut renderers = [base, whole].map(|splats| Renderer::new(splats, 1));
        let mut one = |camera: &Camera| {
            let [a, b] = renderers.each_mut().map(|renderer| renderer.render(camera).rgb);
            psnr(&a, &b)
        };
        cameras().iter().map(&mut one).sum::<f64>() / 6.0
    }

    #[test]
    fn a_base_looks_like_the_whole_model_and_the_same_splats_without_training_do_not() {
        let (whole, cameras) = (ground(), cameras());
        let mut heard = Vec::new();
        let base = base_of(&whole, &cameras, 1, 0, |step, steps| heard.push((step, steps))).expect("a base");
        assert_eq!(heard, (1..=208).map(|step| (step, 208)).collect::<Vec<_>>());
        assert_eq!((base.ids.len(), base.splats.len(), base.splats.sh_degree), (775, 775, 0));
        assert!(base.ids.is_sorted_by(|a, b| a < b) && base.ids.iter().all(|id| *id < 2500));
        assert!(base.ids.iter().zip(&base.splats.quats).all(|(id, quat)| *quat == whole.quats[*id as usize]));
        let mut bare = Splats::with_capacity(775, 1);
        base.ids.iter().for_each(|id| bare.push_from(&whole, *id as usize));
        let (taught, bare) = (likeness(&base.splats, &whole), likeness(&bare, &whole));
        assert!(taught > bare + 6.0 && taught > 20.0, "{taught} dB, {bare} dB as they were");
        // Neither the cache nor the number of threads changes the base.
        assert_eq!(base_of(&whole, &cameras, 2, usize::MAX, |_, _| ()), Some(base));
    }

    #[test]
    fn small_models_and_models_without_cameras_have_no_base() {
        let whole = ground();
        assert_eq!(base_of(&whole, &[], 1, 0, |_, _| ()), None);
        let half = whole.without(&(0..1000).collect::<Vec<_>>());
        assert_eq!(base_of(&half, &cameras(), 1, 0, |_, _| ()), None);
    }
}
