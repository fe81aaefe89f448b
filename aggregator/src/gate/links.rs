//! Measures where the ground that two models share lies in each of them.
//!
//! Patches of one model's pictures are searched in pictures of the other model ([`super::matching`]), in both
//! directions. The matches give pairs of points in space, and the similarity is chosen with which most pairs agree
//! ([`super::consensus`]). This is repeated until the similarity no longer changes. If the models are too far apart for
//! that, the first rounds use small pictures and a wide search.

use cosurf_engine::Renderer;
use cosurf_scene::Camera;

use super::adjust::Link;
use super::consensus::{consensus, distance_px};
use super::features::Feature;
use super::matching::{Matches, Pair, Sight, matches};
use super::similarity::Similarity;
use crate::merge::{Locals, MergeError};

/// Largest distance between the points of a pair that fits, px of the compared pictures. For right models, most pairs
/// are within half of it.
const FIT_PX: f64 = 2.0;
/// Least share of the matches that must fit.
const FIT_SHARE_MIN: f64 = 0.5;
/// Least share of the searched patches that must be found in the other model.
const FOUND_SHARE_MIN: f64 = 0.2;
/// Least number of patches that must be searched.
const SOUGHT_MIN: usize = 24;
/// Least number of pairs that must agree with a similarity.
const AGREEING_MIN: usize = 8;
/// Least share of all pairs that must agree with a similarity.
const AGREEING_SHARE_MIN: f64 = 0.3;
/// A camera is used only if at least this share of its picture shows ground that the other model's own cameras see.
const SHARED_MIN: f64 = 0.15;
/// Limit on the number of a model's cameras of which the shared ground is measured; of more, evenly chosen ones.
const SCOUTS: usize = 128;
/// Limit on the number of a model's cameras through which two models are compared.
const VIEWS: usize = 8;
/// Long side of the pictures that measure how much ground two models share, px.
const SCOUT_PX: u32 = 48;
/// Long side of the largest pictures that are compared, px.
const SIZE_PX: u32 = 320;
/// The rounds in which two models are compared with pictures of [`SIZE_PX`]: the reach of the search, and the tolerance
/// of agreement, px.
const ROUNDS: [(usize, f64); 4] = [(12, 3.0), (6, 2.0), (4, 1.5), (4, 1.5)];
/// The rounds end once the similarity changes by less than this, px.
const SETTLED_PX: f64 = 0.3;
/// The rounds for models that are far apart: the long side of the pictures, the reach of the search, and the tolerance
/// of agreement, px. In the first round, the models may be almost half a picture apart.
const FAR_ROUNDS: [(u32, usize, f64); 3] = [(80, 40, 3.0), (160, 20, 3.0), (SIZE_PX, 12, 3.0)];

/// The cameras of a loaded model, and its renderer.
pub(super) struct Held {
    index: usize,
    cameras: Vec<Camera>,
    renderer: Renderer,
}

impl Held {
    pub(super) fn of(locals: &dyn Locals, index: usize, threads: usize) -> Result<Self, MergeError> {
        let model = locals.load(index)?;
        Ok(Self { index, cameras: model.cameras, renderer: Renderer::new(&model.splats, threads) })
    }

    /// Index of the model.
    pub(super) fn index(&self) -> usize {
        self.index
    }

    /// Places of the model that can be recognised in other models.
    pub(super) fn features(&mut self) -> Vec<Feature> {
        Feature::find(&mut self.renderer, &self.cameras)
    }
}

/// Links two models: first the pairs found in the views of `other`, then those found in the views of `one`. `start` is
/// a guess of the similarity from the frame of `other` to that of `one`. `None` if the models share too little ground,
/// or if they do not fit each other anywhere near.
pub(super) fn links(one: &mut Held, other: &mut Held, start: &Similarity) -> Option<(Similarity, [Link; 2])> {
    let near = converge(one, other, start);
    let (one_from_other, seen) = near.or_else(|| {
        let closer = approach(one, other, start)?;
        converge(one, other, &closer)
    })?;
    // With a wide search, a wrong similarity also finds matches far away. These lower the share of matches that fit.
    let wide = (seen.reach_px < ROUNDS[0].0).then(|| look(other, one, &one_from_other, SIZE_PX, ROUNDS[0].0));
    fits(wide.as_ref().unwrap_or(&seen.forth), &one_from_other).then(|| {
        let [forth, back] = [seen.forth, seen.back].map(|matches| matches.found);
        let links = [
            Link { models: [one.index, other.index], pairs: forth },
            Link { models: [other.index, one.index], pairs: back },
        ];
        (one_from_other, links)
    })
}

/// What one round of comparisons has found.
struct Seen {
    /// Matches in the views of the second model, and in those of the first.
    forth: Matches,
    back: Matches,
    /// Reach of the search, px.
    reach_px: usize,
}

/// Repeats the comparison with large pictures until the similarity has settled.
fn converge(one: &mut Held, other: &mut Held, start: &Similarity) -> Option<(Similarity, Seen)> {
    let mut one_from_other = *start;
    let mut last = None;
    for (reach_px, tolerance_px) in ROUNDS {
        let forth = look(other, one, &one_from_other, SIZE_PX, reach_px);
        let back = look(one, other, &one_from_other.inverse(), SIZE_PX, reach_px);
        let mut pairs = forth.found.clone();
        pairs.extend(back.swapped().found);
        let found = agreed(&pairs, tolerance_px)?;
        let change_px = change_px(&pairs, &found, &one_from_other);
        one_from_other = found;
        last = Some(Seen { forth, back, reach_px });
        if change_px < SETTLED_PX {
            break;
        }
    }
    Some((one_from_other, last?))
}

/// Brings two models that are far apart closer to each other.
fn approach(one: &mut Held, other: &mut Held, start: &Similarity) -> Option<Similarity> {
    let mut one_from_other = *start;
    for (size_px, reach_px, tolerance_px) in FAR_ROUNDS {
        let seen = look(other, one, &one_from_other, size_px, reach_px);
        one_from_other = agreed(&seen.found, tolerance_px)?;
    }
    Some(one_from_other)
}

/// The similarity with which most pairs agree; `None` if too few agree.
fn agreed(pairs: &[Pair], tolerance_px: f64) -> Option<Similarity> {
    let (found, agreeing) = consensus(pairs, tolerance_px)?;
    let is_enough = agreeing >= AGREEING_MIN && agreeing as f64 >= AGREEING_SHARE_MIN * pairs.len() as f64;
    is_enough.then_some(found)
}

/// Root mean square of the distances by which two similarities differ at the points of the pairs, px.
fn change_px(pairs: &[Pair], a: &Similarity, b: &Similarity) -> f64 {
    let squared = |pair: &Pair| {
        let distance = a.apply(pair.other).distance(b.apply(pair.other));
        (distance / pair.trusted_pixel_m).powi(2)
    };
    (pairs.iter().map(squared).sum::<f64>() / pairs.len().max(1) as f64).sqrt()
}

/// Searches patches of `trusted` in views of `other`. `from_other` moves the cameras of `other` into the frame of
/// `trusted`, so that both models are rendered from the same place.
fn look(
    other: &mut Held,
    trusted: &mut Held,
    from_other: &Similarity,
    size_px: u32,
    reach_px: usize,
) -> Matches {
    let resized = |camera: &Camera, size_px| camera.resized(camera.fitted_size(size_px));
    let mut shares: Vec<(f64, Camera)> = Vec::new();
    let scouts = SCOUTS.min(other.cameras.len());
    for camera in (0..scouts).map(|i| &other.cameras[i * other.cameras.len() / scouts]) {
        let scout = resized(&from_other.camera(camera), SCOUT_PX);
        let share = Sight::of(&mut trusted.renderer, scout).shared(&trusted.cameras);
        shares.push((share, *camera));
    }
    shares.retain(|(share, _)| *share >= SHARED_MIN);
    shares.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut seen = Matches::default();
    for (_, camera) in shares.into_iter().take(VIEWS) {
        let camera = resized(&camera, size_px);
        let shown = Sight::of(&mut trusted.renderer, from_other.camera(&camera));
        let there = Sight::of(&mut other.renderer, camera);
        seen.extend(matches(&shown, &trusted.cameras, &there, reach_px));
    }
    seen
}

/// Whether enough patches were searched and found, and enough matches fit.
fn fits(seen: &Matches, one_from_other: &Similarity) -> bool {
    let found = seen.found.len() as f64;
    let near = seen.found.iter().filter(|pair| distance_px(pair, one_from_other) <= FIT_PX).count() as f64;
    seen.sought >= SOUGHT_MIN
        && found >= FOUND_SHARE_MIN * seen.sought as f64
        && near >= FIT_SHARE_MIN * found
}

#[cfg(test)]
pub(super) mod tests;
