//! Pruning chooses splats to remove: the least important (CoSurfGS, "Adaptive Gaussian Pruning"), those that too few
//! views observe (PGSR), and useless ones.

use cosurf_scene::{Camera, Splats};
use tracing::debug_span;

use crate::backend::{Backend, Channels, Scores, Shapes};

/// Exponent of the relative size in the importance (LightGaussian).
const SIZE_EXPONENT: f32 = 0.1;
/// The relative size of a splat is its size divided by this quantile of all sizes, at most 1.
const SIZE_QUANTILE: f64 = 0.9;

/// The formula for the importance of a splat.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum PruneScore {
    /// `Σ (α T)² γ` over all pixels of all views: α is the splat's alpha at a pixel, T the transmittance in front of
    /// it, and γ the tenth root of the splat's area, relative to the areas of all splats. Hidden splats have little
    /// importance, and flat splats do not count as small. A splat that fills few pixels alone is more important than
    /// one that adds a little to many pixels.
    #[default]
    Corrected,
    /// `hits o γ`, as in the paper: `hits` is the number of pixels that the splat was blended into, o its opacity, and
    /// γ the tenth root of its volume, relative to the volumes of all splats.
    Paper,
}

/// Renders the view of each camera, and returns the scores of all splats over all these views.
pub(crate) fn survey<'a, B: Backend>(
    backend: &mut B,
    cameras: impl IntoIterator<Item = &'a Camera>,
) -> Scores {
    let _span = debug_span!("survey", splats = backend.len()).entered();
    backend.clear_scores();
    for camera in cameras {
        backend.project(camera, 0);
        backend.bin();
        backend.rasterize(Channels::Color);
        backend.score();
    }
    backend.scores()
}

/// The number of pixels of the views that each splat was blended into. For the first `first` splats, the number is 0 only
/// if no view shows them; otherwise it may be too small. Views that can show no splat for the first time are not rendered:
/// they took a twentieth of the time of a merge.
pub(crate) fn hits<'a, B: Backend>(
    backend: &mut B,
    cameras: impl IntoIterator<Item = &'a Camera>,
    first: usize,
) -> Vec<f32> {
    let _span = debug_span!("survey", splats = first).entered();
    backend.clear_scores();
    for camera in cameras {
        backend.project(camera, 0);
        if backend.may_score_new_hits(first) {
            backend.bin();
            backend.rasterize(Channels::Color);
            backend.score();
        }
    }
    backend.scores().hits
}

/// Importance of each splat by the formula `score`.
pub(crate) fn importance_by(shapes: &Shapes, scores: &Scores, score: PruneScore) -> Vec<f32> {
    let sizes: Vec<f32> = shapes.log_scales.iter().map(|log_scale| size(*log_scale, score)).collect();
    let reference = quantile(&sizes, SIZE_QUANTILE);
    (0..sizes.len())
        .map(|i| {
            let share =
                libm::powf((sizes[i] / reference.max(f32::MIN_POSITIVE)).clamp(0.0, 1.0), SIZE_EXPONENT);
            let contribution = match score {
                PruneScore::Corrected => scores.squared_weights[i],
                PruneScore::Paper => scores.hits[i] / (1.0 + libm::expf(-shapes.opacity_logits[i])),
            };
            contribution * share
        })
        .collect()
}

/// Size of a splat: the product of its two longest scales, or of all three for the paper's formula.
fn size(log_scale: [f32; 3], score: PruneScore) -> f32 {
    let sum: f32 = log_scale.iter().sum();
    match score {
        PruneScore::Corrected => libm::expf(sum - log_scale.into_iter().fold(f32::INFINITY, f32::min)),
        PruneScore::Paper => libm::expf(sum),
    }
}

fn quantile(values: &[f32], share: f64) -> f32 {
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f32::total_cmp);
    let place = (share * sorted.len().saturating_sub(1) as f64).round() as usize;
    sorted.get(place).copied().unwrap_or(0.0)
}

/// Indices, ascending, of the least important share `ratio` (0..1) of all splats; on a tie, the later splats.
pub(crate) fn lowest(importance: &[f32], ratio: f64) -> Vec<u32> {
    least(importance, (ratio.clamp(0.0, 1.0) * importance.len() as f64) as usize)
}

/// Indices, ascending, of the `count` least important splats; on a tie, the later splats.
pub(crate) fn least(importance: &[f32], count: usize) -> Vec<u32> {
    let mut order: Vec<u32> = (0..importance.len() as u32).collect();
    let key = |i: u32| importance[i as usize];
    order.sort_unstable_by(|&a, &b| key(a).total_cmp(&key(b)).then(b.cmp(&a)));
    order.truncate(count);
    order.sort_unstable();
    order
}

/// Indices, ascending, of splats that fewer than `observers_min` views observe.
pub(crate) fn unobserved(scores: &Scores, observers_min: u32) -> Vec<u32> {
    let stays = |i: &u32| scores.observers[*i as usize] >= observers_min as f32;
    (0..scores.observers.len() as u32).filter(|i| !stays(i)).collect()
}

/// Indices, ascending, of splats that are less opaque than `opacity_min`, larger than `scale_max` (world units), or
/// invisible in all views. `hits` is the number of pixels that each splat was blended into ([`Scores::hits`]); splats
/// beyond its end are left out.
pub(crate) fn useless(splats: &Splats, hits: &[f32], opacity_min: f32, scale_max: f32) -> Vec<u32> {
    let logit_min = libm::logf(opacity_min / (1.0 - opacity_min));
    let log_scale_max = libm::logf(scale_max);
    // A comparison with NaN is false, so splats with NaN are removed.
    let stays = |i: usize| {
        splats.opacity_logits[i] >= logit_min
            && splats.log_scales[i].iter().all(|log_scale| *log_scale <= log_scale_max)
            && hits[i] > 0.0
    };
    (0..hits.len() as u32).filter(|&i| !stays(i as usize)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exactly_the_least_important_are_chosen_and_of_equals_the_later() {
        let importance = [3.0, 1.0, 2.0, 1.0, 1.0, 9.0, 0.5, 7.0];
        assert_eq!(lowest(&importance, 0.25), [4, 6]);
        assert_eq!(lowest(&importance, 0.5), [1, 3, 4, 6]);
        assert_eq!(lowest(&importance, 0.0), [0u32; 0]);
        assert_eq!(lowest(&importance, 1.0).len(), 8);
        assert_eq!(lowest(&[], 0.5), [0u32; 0]);
    }

    /// Four splats: one visible, one hidden of the same size, one tiny, one flat.
    fn four() -> (Shapes, Scores) {
        let shapes = Shapes {
            log_scales: vec![[-1.0; 3], [-1.0; 3], [-5.0; 3], [-1.0, -1.0, -30.0]],
            opacity_logits: vec![2.0; 4],
            ..Shapes::default()
        };
        let scores = Scores {
            squared_weights: vec![50.0, 0.1, 50.0, 50.0],
            hits: vec![100.0; 4],
            observers: vec![5.0, 0.0, 2.0, 1.0],
        };
        (shapes, scores)
    }

    #[test]
    fn the_corrected_score_regards_occlusion_and_flatness_and_the_papers_does_not() {
        let (shapes, scores) = four();
        let corrected = importance_by(&shapes, &scores, PruneScore::Corrected);
        assert!(corrected[1] < 0.01 * corrected[0], "hidden splats have little importance: {corrected:?}");
        assert_eq!(corrected[3], corrected[0], "a flat splat is as large as a thick one");
        assert!(corrected[2] < corrected[0]);
        let paper = importance_by(&shapes, &scores, PruneScore::Paper);
        assert_eq!(paper[1], paper[0], "the paper's score ignores what is in front");
        assert!(paper[3] < 0.1 * paper[0], "by volume, a flat splat has no size");
    }

    #[test]
    fn transparent_huge_and_invisible_splats_are_useless() {
        let (shapes, scores) = four();
        let mut splats = Splats::with_capacity(4, 0);
        for (log_scale, opacity_logit) in shapes.log_scales.iter().zip(&shapes.opacity_logits) {
            splats.push([0.0; 3], [1.0, 0.0, 0.0, 0.0], *log_scale, *opacity_logit, &[0.0; 3]);
        }
        splats.opacity_logits[0] = -6.0;
        splats.log_scales[2] = [3.0, -1.0, -1.0];
        let mut hits = scores.hits;
        hits[3] = 0.0;
        assert_eq!(useless(&splats, &hits, 0.005, 10.0), [0, 2, 3]);
        assert_eq!(useless(&splats, &hits, 0.001, 30.0), [3]);
    }

    #[test]
    fn splats_that_too_few_views_observe_are_found() {
        assert_eq!(unobserved(&four().1, 2), [1, 3]);
        assert_eq!(unobserved(&four().1, 1), [1]);
    }
}
