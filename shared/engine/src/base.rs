//! A base: a third of a model's splats, taught to stand in for all of it. Who sends it first has sent a model, wherever
//! the link breaks off.
//!
//! The most important splats as they are leave holes: with a fifth of the bytes of four agents' models of rendered Boruszyn
//! (240 px) the merged model lost 8.4 dB. So they are distilled from what the whole model shows to its own cameras:
//! first half of the splats, then those of them that turned out to give most. That loses 1.8 dB there, and where means
//! stay in their places 0.5 dB more. Quaternions stay, for telling how they turn back takes as much as they bring.

use std::rc::Rc;

use cosurf_scene::{Base, Camera, Splats, camera};

use crate::backend::{Backend, Channels, Rendering, TargetSurface};
use crate::cpu::{CpuBackend, CpuCapacity};
use crate::distill::{DistillSettings, Distiller, Lesson, StudentRates};
use crate::render::Renderer;
use crate::train::view_order;

/// Share of the splats in a base: at 9.3 bytes each, a fifth of the 15.8 that a splat takes in all.
const SHARE: f64 = 0.31;
/// Share that begins. Where all do, few survive of those that fill the holes; where no more than remain, the wrong ones do
/// (rendered Boruszyn, one agent, against the whole model: 34.7 and 35.3 instead of 36.7 dB).
const SHARE_AT_FIRST: f64 = 0.5;
/// A model of fewer splats is sent soon enough without a base.
const SPLATS_MIN: usize = 2000;
/// Where one splat in k begins, its lengths grow by k to this power: those that matter most are large already.
const GROWTH: f32 = 0.25;

/// Steps with the half, and with the third. Ten epochs instead of six bring 0.6 dB against the whole.
const STEPS: [u32; 2] = [52, 104];
/// Steps at the end of either in which all settles.
const SETTLE: u32 = 26;
/// Three times those of 3DGS, for there is little time, and twice for opacities. Found on rendered Boruszyn.
const RATES: StudentRates =
    StudentRates { mean: 4.8e-4, quat: 0.0, log_scale: 0.02, opacity: 0.1, sh_dc: 0.0075 };

/// A surface that shows less than this is not taught.
const ALPHA_MIN: f32 = 0.95;

/// The base of a model that `cameras` have seen; `None` where it is too small to need one. The processor makes it, with
/// `threads`, at least 1; `kept_bytes` may be taken for renderings that are needed again. `tell` hears the steps done and
/// those in all. The same model gives the same base.
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
    let mut base = beginning(splats, cameras, threads);
    let mut teacher = Teacher::new(splats, cameras, threads, kept_bytes);
    for (stage, steps) in STEPS.into_iter().enumerate() {
        if stage > 0 {
            let count = (SHARE * splats.len() as f64) as usize;
            base = chosen(&base, &most_important(&base.splats, cameras, count, threads));
        }
        base.splats = teacher.teach(&base.splats, steps, |step| {
            tell(STEPS[..stage].iter().sum::<u32>() + step, STEPS.iter().sum());
        });
    }
    Some(base)
}

/// The splats that the model needs most, larger, and of one colour in all directions.
fn beginning(splats: &Splats, cameras: &[Camera], threads: usize) -> Base {
    let count = (SHARE_AT_FIRST * splats.len() as f64) as usize;
    let ids = most_important(splats, cameras, count, threads);
    let growth = GROWTH * (splats.len() as f32 / count as f32).ln();
    let mut grown = Splats::with_capacity(count, 0);
    for i in ids.iter().map(|&i| i as usize) {
        let log_scale = splats.log_scales[i].map(|v| v + growth);
        let color = &splats.sh_of(i)[..3];
        grown.push(splats.means[i], splats.quats[i], log_scale, splats.opacity_logits[i], color);
    }
    Base { ids, splats: grown }
}

/// Indices of the `count` splats that the pictures of `cameras` need most, ascending; of equals the first.
fn most_important(splats: &Splats, cameras: &[Camera], count: usize, threads: usize) -> Vec<u32> {
    let importance = Renderer::new(splats, threads).importance(cameras);
    let mut ranked: Vec<u32> = (0..splats.len() as u32).collect();
    ranked.sort_by(|&a, &b| importance[b as usize].total_cmp(&importance[a as usize]));
    ranked.truncate(count);
    ranked.sort_unstable();
    ranked
}

/// The base of those in `places`, ascending.
fn chosen(base: &Base, places: &[u32]) -> Base {
    let mut splats = Splats::with_capacity(places.len(), base.splats.sh_degree);
    places.iter().for_each(|&place| splats.push_from(&base.splats, place as usize));
    Base { ids: places.iter().map(|&place| base.ids[place as usize]).collect(), splats }
}

/// The whole model, which shows what it looks like.
struct Teacher<'a> {
    threads: usize,
    cameras: &'a [Camera],
    renderer: Renderer,
    kept: Vec<Option<Rc<Rendering>>>,
    /// Bytes that more may take.
    free_bytes: usize,
}

impl<'a> Teacher<'a> {
    fn new(splats: &Splats, cameras: &'a [Camera], threads: usize, kept_bytes: usize) -> Self {
        Self {
            threads,
            cameras,
            renderer: Renderer::new(splats, threads),
            kept: vec![None; cameras.len()],
            free_bytes: kept_bytes,
        }
    }

    /// What `student` has learnt after so many steps.
    fn teach(&mut self, student: &Splats, steps: u32, mut tell: impl FnMut(u32)) -> Splats {
        let room = CpuCapacity::to_train(student, self.cameras, Channels::Geometry);
        let mut backend = CpuBackend::new(room, self.threads);
        backend.load(student);
        let settings = DistillSettings {
            steps,
            settle: SETTLE,
            rates: RATES,
            extent: Some(camera::extent(self.cameras.iter())).filter(|extent| *extent > 0.0).unwrap_or(1.0),
            depth: median_depth(&self.show(0)),
            sh_degree: student.sh_degree,
        };
        let mut distiller = Distiller::new(backend, settings);
        let views = self.cameras.len() as u32;
        for step in 0..steps {
            let order = view_order(0, u64::from(step / views), self.cameras.len());
            let view = order[(step % views) as usize];
            let Rendering { rgb, alpha, depth, normal, .. } = &*self.show(view);
            let trust: Vec<f32> = alpha.iter().map(|a| f32::from(u8::from(*a > ALPHA_MIN))).collect();
            let surface = TargetSurface { depth, normal, trust: &trust };
            distiller.step(&Lesson { camera: &self.cameras[view], rgb, surface });
            tell(step + 1);
        }
        distiller.finish([]).0
    }

    fn show(&mut self, view: usize) -> Rc<Rendering> {
        if let Some(kept) = &self.kept[view] {
            return kept.clone();
        }
        let rendering = Rc::new(self.renderer.render(&self.cameras[view]));
        let Rendering { rgb, alpha, depth, normal, .. } = &*rendering;
        let bytes: usize = [rgb, alpha, depth, normal].map(|values| size_of_val(&values[..])).iter().sum();
        if bytes <= self.free_bytes {
            self.free_bytes -= bytes;
            self.kept[view] = Some(rendering.clone());
        }
        rendering
    }
}

/// Median depth of what a picture shows, world units.
fn median_depth(rendering: &Rendering) -> f64 {
    let mut depths: Vec<f32> = rendering.depth.iter().copied().filter(|depth| *depth > 0.0).collect();
    depths.sort_unstable_by(f32::total_cmp);
    depths.get(depths.len() / 2).map_or(1.0, |depth| f64::from(*depth))
}

#[cfg(test)]
mod tests {
    use cosurf_scene::Pose;
    use cosurf_scene::metrics::psnr;
    use glam::{DQuat, DVec2, DVec3};

    use super::*;

    /// Ground of flat tiles, 50 × 50, of many colours.
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
    fn a_base_looks_like_the_whole_and_far_more_so_than_its_splats_as_they_were() {
        let (whole, cameras) = (ground(), cameras());
        let mut heard = Vec::new();
        let base = base_of(&whole, &cameras, 1, 0, |step, steps| heard.push((step, steps))).expect("a base");
        assert_eq!(heard, (1..=156).map(|step| (step, 156)).collect::<Vec<_>>());
        assert_eq!((base.ids.len(), base.splats.len(), base.splats.sh_degree), (775, 775, 0));
        assert!(base.ids.is_sorted_by(|a, b| a < b) && base.ids.iter().all(|id| *id < 2500));
        assert!(base.ids.iter().zip(&base.splats.quats).all(|(id, quat)| *quat == whole.quats[*id as usize]));
        let mut bare = Splats::with_capacity(775, 1);
        base.ids.iter().for_each(|id| bare.push_from(&whole, *id as usize));
        let (taught, bare) = (likeness(&base.splats, &whole), likeness(&bare, &whole));
        assert!(taught > bare + 6.0 && taught > 20.0, "{taught} dB, {bare} dB as they were");
        // Whatever is kept and however many compute, it is the same base.
        assert_eq!(base_of(&whole, &cameras, 2, usize::MAX, |_, _| ()), Some(base));
    }

    #[test]
    fn small_models_and_those_that_nobody_has_seen_have_none() {
        let whole = ground();
        assert_eq!(base_of(&whole, &[], 1, 0, |_, _| ()), None);
        let half = whole.without(&(0..1000).collect::<Vec<_>>());
        assert_eq!(base_of(&half, &cameras(), 1, 0, |_, _| ()), None);
    }
}
