//! Refinement: decides from shapes and statistics which splats to split and remove, within the capacity.
//!
//! A splat is split in the middle of its longest axis (Improved-GS, arXiv 2508.12313), so that its two children together
//! look almost as it did. In 3DGS, children lie at random places, and a small splat stays while a copy of it is added: both
//! change the picture, and the training has to repair that. After 600 steps at 320 px, which take as long either way, rendered
//! Boruszyn has 34.7 dB instead of 33.5, with 214,000 splats instead of 226,000; Caliterra has 33.4 dB instead of 33.2, with
//! the same number of splats.

use glam::{Quat, Vec3};
use rayon::prelude::*;

use crate::backend::{Birth, Edit, Shapes};

/// Mean screen gradient from which on a splat is split (3DGS).
const SCREEN_GRADIENT_MIN: f32 = 2e-4;
/// Mean absolute screen gradient from which on a large splat is split, whatever its mean screen gradient (PGSR).
const ABSOLUTE_GRADIENT_MIN: f32 = 8e-4;
/// A splat is large if its largest scale is above this share of the scene's extent. 3DGS, where it is called `percent_dense`,
/// has 0.01.
const LARGE_SCALE_MIN: f64 = 0.006;
/// Distance from the centre of a splat to the centre of each of its two children, as a share of its longest scale.
const CHILD_DISTANCE: f32 = 0.9;
/// Longest scale of a child, as a share of its parent's (Improved-GS).
const CHILD_LENGTH: f32 = 0.5;
/// Other scales of a child, as a share of its parent's (Improved-GS).
const CHILD_WIDTH: f32 = 0.85;
/// Opacity of a child, as a share of its parent's. Improved-GS has 0.6; on rendered Boruszyn 0.45, 0.6, 0.8 and 1 give 34.1,
/// 34.6, 34.7 and 34.4 dB (600 steps at 320 px).
const CHILD_OPACITY: f32 = 0.8;
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
        |i: usize| libm::exp(f64::from(largest(shapes.log_scales[i]))) <= LARGE_SCALE_MIN * limits.extent;
    let demand = |i: usize| {
        let pulled = shapes.screen_gradients[i] / SCREEN_GRADIENT_MIN;
        let torn = shapes.absolute_gradients[i] / ABSOLUTE_GRADIENT_MIN;
        if is_small(i) { pulled } else { pulled.max(torn) }
    };
    let demands: Vec<f32> = (0..n).into_par_iter().map(|i| if dead[i] { 0.0 } else { demand(i) }).collect();
    let parents = choose_parents(&demands, limits.splats_max.saturating_sub(survivors));

    let births = parents.par_iter().flat_map_iter(|parent| children(shapes, *parent)).collect();
    let mut removed = dead;
    parents.iter().for_each(|parent| removed[*parent] = true);
    Edit { births, deaths: (0..n as u32).filter(|i| removed[*i as usize]).collect() }
}

/// Indices, ascending, of the splats to split: at most `room`, those with the largest demands. The demand of a splat is its
/// screen gradient divided by the threshold of that gradient. Splats with a demand below 1 are not split. Each split adds one
/// splat to the model.
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

/// The two splats that replace `parent`. They lie on its longest axis, one on each side of its centre.
fn children(shapes: &Shapes, parent: usize) -> [Birth; 2] {
    let [w, x, y, z] = shapes.quats[parent];
    let rotation = Quat::from_xyzw(x, y, z, w).normalize();
    let log_scale = shapes.log_scales[parent];
    let longest = (1..3).fold(0, |best, axis| if log_scale[axis] > log_scale[best] { axis } else { best });
    let mut offset = Vec3::ZERO;
    offset[longest] = CHILD_DISTANCE * libm::expf(log_scale[longest]);
    let offset = rotation * offset;
    let mut child_scale = log_scale.map(|scale| scale + libm::logf(CHILD_WIDTH));
    child_scale[longest] = log_scale[longest] + libm::logf(CHILD_LENGTH);
    let opacity = CHILD_OPACITY / (1.0 + libm::expf(-shapes.opacity_logits[parent]));
    let child = |side: f32| Birth {
        parent: parent as u32,
        mean: (Vec3::from(shapes.means[parent]) + side * offset).to_array(),
        log_scale: child_scale,
        opacity_logit: libm::logf(opacity / (1.0 - opacity)),
    };
    [child(1.0), child(-1.0)]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Splats of which the `i`-th has the demand `i`, each with its longest axis along its own y.
    fn shapes(count: usize) -> Shapes {
        Shapes {
            means: (0..count).map(|i| [i as f32, 0.0, 0.0]).collect(),
            quats: vec![[0.5; 4]; count],
            log_scales: vec![[-3.0, -1.0, -2.0]; count],
            opacity_logits: vec![0.0; count],
            screen_gradients: (0..count).map(|i| i as f32 * SCREEN_GRADIENT_MIN).collect(),
            absolute_gradients: vec![0.0; count],
            views: vec![1.0; count],
        }
    }

    fn limits(splats_max: usize) -> RefineLimits {
        RefineLimits { splats_max, extent: 100.0, prune_large: false }
    }

    #[test]
    fn a_splat_is_split_in_the_middle_of_its_longest_axis() {
        let Edit { births, deaths } = refine(&shapes(2), &limits(10));
        assert_eq!(deaths, [1]);
        // This quaternion turns y into z.
        let distance = CHILD_DISTANCE * (-1.0f32).exp();
        for (birth, side) in births.iter().zip([1.0, -1.0]) {
            assert_eq!(birth.parent, 1);
            assert!(Vec3::from(birth.mean).distance(Vec3::new(1.0, 0.0, side * distance)) < 1e-6);
            let [thin, long, wide] = birth.log_scale.map(f32::exp);
            assert!(thin < wide && wide < long && long < 0.51 * (-1.0f32).exp());
            let opacity = 1.0 / (1.0 + (-birth.opacity_logit).exp());
            assert!((opacity - 0.5 * CHILD_OPACITY).abs() < 1e-6);
        }
        assert_eq!(births.len(), 2);
    }

    #[test]
    fn those_with_the_largest_demands_are_split_as_far_as_there_is_room() {
        let Edit { births, deaths } = refine(&shapes(8), &limits(11));
        assert_eq!(deaths, [5, 6, 7]);
        assert_eq!(births.len(), 6);
        assert!(refine(&shapes(8), &limits(8)).births.is_empty());
    }

    #[test]
    fn faint_and_broken_splats_are_removed() {
        let mut shapes = shapes(4);
        shapes.opacity_logits[0] = -10.0;
        shapes.means[3][1] = f32::NAN;
        assert_eq!(refine(&shapes, &limits(4)).deaths, [0, 1, 2, 3]);
    }
}
