//! Refinement: decides from shapes and statistics which splats to clone, split and remove, within the capacity.

use glam::{Quat, Vec3};
use rayon::prelude::*;

use crate::backend::{Birth, Edit, Shapes};
use crate::random::{Purpose, Random};

/// Mean screen gradient from which on a splat is cloned or split (3DGS).
const SCREEN_GRADIENT_MIN: f32 = 2e-4;
/// Mean absolute screen gradient from which on a large splat is split, whatever its mean screen gradient (PGSR).
const ABSOLUTE_GRADIENT_MIN: f32 = 8e-4;
/// Splats whose largest scale is up to this share of the scene extent are cloned; larger splats are split. In 3DGS this
/// is `percent_dense`, 0.01.
const CLONE_SCALE_MAX: f64 = 0.006;
/// The scales of the two children of a split are divided by this factor (3DGS: 0.8 × the number of children).
const SPLIT_SHRINK: f32 = 1.6;
/// Splats with a lower opacity are removed (3DGS).
const OPACITY_MIN: f32 = 0.005;
/// Splats whose largest scale exceeds this share of the scene extent are removed, once opacities have been reset for
/// the first time (3DGS).
const SCALE_MAX: f64 = 0.1;

/// Limits of a refinement.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RefineLimits {
    /// Largest number of splats afterwards.
    pub(crate) splats_max: usize,
    /// Scene extent, world units.
    pub(crate) extent: f64,
    /// Whether splats above [`SCALE_MAX`] are removed as well.
    pub(crate) prune_large: bool,
    pub(crate) seed: u64,
    pub(crate) step: u32,
}

/// Decides which splats one refinement adds and removes, with the threads of the current rayon pool. On one thread it took
/// as long as eight training steps on a graphics card.
pub(crate) fn refine(shapes: &Shapes, limits: &RefineLimits) -> Edit {
    let n = shapes.opacity_logits.len();
    let logit_min = libm::logf(OPACITY_MIN / (1.0 - OPACITY_MIN));
    let log_scale_max = libm::log(SCALE_MAX * limits.extent) as f32;
    let dies = |i: usize| {
        // A comparison with NaN is false, so splats with NaN are removed.
        let keeps = shapes.opacity_logits[i] >= logit_min
            && (!limits.prune_large || largest(shapes.log_scales[i]) <= log_scale_max)
            && shapes.means[i].iter().chain(&shapes.log_scales[i]).all(|v| v.is_finite());
        !keeps
    };
    let dead: Vec<bool> = (0..n).into_par_iter().map(dies).collect();
    let survivors = dead.iter().filter(|dead| !**dead).count();
    let is_small =
        |i: usize| libm::exp(f64::from(largest(shapes.log_scales[i]))) <= CLONE_SCALE_MAX * limits.extent;
    let demand = |i: usize| {
        let pulled = shapes.screen_gradients[i] / SCREEN_GRADIENT_MIN;
        let torn = shapes.absolute_gradients[i] / ABSOLUTE_GRADIENT_MIN;
        if is_small(i) { pulled } else { pulled.max(torn) }
    };
    let demands: Vec<f32> = (0..n).into_par_iter().map(|i| if dead[i] { 0.0 } else { demand(i) }).collect();
    let parents = choose_parents(&demands, limits.splats_max.saturating_sub(survivors));

    let children = |&parent: &usize| {
        let mut random = Random::new(limits.seed, Purpose::Birth, u64::from(limits.step), parent as u64);
        let (count, shrink) = if is_small(parent) { (1, 1.0) } else { (2, SPLIT_SHRINK) };
        (0..count).map(move |_| child(shapes, parent, shrink, &mut random))
    };
    let births = parents.par_iter().flat_map_iter(children).collect();
    let mut removed = dead;
    parents.iter().filter(|parent| !is_small(**parent)).for_each(|parent| removed[*parent] = true);
    Edit { births, deaths: (0..n as u32).filter(|i| removed[*i as usize]).collect() }
}

/// Indices, ascending, of the splats to clone or split: at most `room`, those with the largest demands. A demand is a
/// screen gradient divided by its threshold; demands below 1 do not count. Each clone and each split adds one splat to
/// the model.
fn choose_parents(demands: &[f32], room: usize) -> Vec<usize> {
    let mut parents: Vec<usize> = (0..demands.len()).filter(|&i| demands[i] >= 1.0).collect();
    if parents.len() > room {
        // Largest demand first, ties by index, so that the choice is deterministic.
        parents.select_nth_unstable_by(room, |&a, &b| demands[b].total_cmp(&demands[a]).then(a.cmp(&b)));
        parents.truncate(room);
        parents.sort_unstable();
    }
    parents
}

fn largest(log_scale: [f32; 3]) -> f32 {
    log_scale.into_iter().fold(f32::NEG_INFINITY, f32::max)
}

/// A child at a random position, drawn from the Gaussian of its parent. Its scales are those of the parent, divided by
/// `shrink`.
fn child(shapes: &Shapes, parent: usize, shrink: f32, random: &mut Random) -> Birth {
    let [w, x, y, z] = shapes.quats[parent];
    let rotation = Quat::from_xyzw(x, y, z, w).normalize();
    let scale = Vec3::from(shapes.log_scales[parent].map(libm::expf));
    let offset = rotation * (scale * Vec3::new(random.normal(), random.normal(), random.normal()));
    Birth {
        parent: parent as u32,
        mean: (Vec3::from(shapes.means[parent]) + offset).to_array(),
        log_scale: shapes.log_scales[parent].map(|v| v - libm::logf(shrink)),
        opacity_logit: shapes.opacity_logits[parent],
    }
}
