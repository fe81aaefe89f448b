//! Measures where the ground that two models share lies in each of them.
//!
//! Patches of one model's pictures are searched in pictures of the other model ([`super::matching`]), in both
//! directions. The matches give pairs of points in space, and the similarity is chosen with which most pairs agree
//! ([`super::consensus`]). This is repeated until the similarity no longer changes. If the models are too far apart for
//! that, the first rounds use small pictures and a wide search.

use std::path::Path;

use cosurf_engine::Renderer;
use cosurf_link::Model;
use cosurf_scene::Camera;

use super::adjust::Link;
use super::consensus::{Tolerance, consensus};
use super::features::Feature;
use super::matching::{Matches, Pair, Sight, matches};
use super::scouts::{Scout, ScoutFile, best};
use super::similarity::Similarity;
use crate::merge::shifts::Shifts;
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
/// Limit on the number of a model's cameras through which two models are compared.
const VIEWS: usize = 8;
/// Long side of the largest pictures that are compared, px.
const SIZE_PX: u32 = 320;
/// The rounds in which two models are compared with pictures of [`SIZE_PX`]: the reach of the search, and the tolerance
/// of agreement, px.
const ROUNDS: [(usize, f64); 4] = [(12, 3.0), (6, 2.0), (4, 1.5), (4, 1.5)];
/// The rounds end once the similarity changes by less than this, px.
const SETTLED_PX: f64 = 0.3;
/// If the first round changed the similarity by less than this, px, it searched around the right places: most matches
/// were within its reach.
const NEAR_PX: f64 = 4.0;
/// The rounds for models that are far apart: the long side of the pictures, the reach of the search, and the tolerance
/// of agreement, px. In the first round, the models may be almost half a picture apart.
const FAR_ROUNDS: [(u32, usize, f64); 3] = [(80, 40, 3.0), (160, 20, 3.0), (SIZE_PX, 12, 3.0)];

/// The cameras of a loaded model, and its renderer.
pub(super) struct Held {
    index: usize,
    cameras: Vec<Camera>,
    scouts: Vec<Scout>,
    renderer: Renderer,
}

/// All models, and what each shows from its own cameras.
pub(super) struct Scouted<'a> {
    locals: &'a dyn Locals,
    scouts: ScoutFile,
}

impl<'a> Scouted<'a> {
    /// Renders what all models show from their own cameras: [`ScoutFile::of`].
    pub(super) fn of(
        locals: &'a dyn Locals,
        shifts: Shifts,
        scratch: &Path,
        is_given_up: &dyn Fn() -> bool,
    ) -> Result<Self, MergeError> {
        Ok(Self { locals, scouts: ScoutFile::of(locals, shifts, scratch, is_given_up)? })
    }

    /// Number of models.
    pub(super) fn count(&self) -> usize {
        self.locals.count()
    }

    /// Loads a model. `threads` threads will render it.
    pub(super) fn hold(&self, index: usize, threads: usize) -> Result<Held, MergeError> {
        let Model { splats, cameras } = self.locals.load(index)?;
        let renderer = Renderer::new(&splats, threads);
        Ok(Held { index, cameras, scouts: self.scouts.read(index)?, renderer })
    }
}

impl Held {
    /// Index of the model.
    pub(super) fn index(&self) -> usize {
        self.index
    }

    /// The cameras whose pictures show most ground that the cameras of `other` see. `other_from_own` moves them into the
    /// frame of `other`.
    fn views(&self, other: &Self, other_from_own: &Similarity) -> Vec<Camera> {
        best(&self.scouts, other_from_own, &other.cameras, VIEWS)
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
    // Depths of poor models are far worse than their pictures. If they count less from the start, models that are far apart
    // may converge to a wrong place.
    let ways: [fn(f64) -> Tolerance; 2] = [Tolerance::in_space, Tolerance::in_pictures];
    let (one_from_other, seen) = ways.into_iter().find_map(|tolerance| {
        converge(one, other, start, tolerance).or_else(|| {
            let closer = approach(one, other, start, tolerance)?;
            converge(one, other, &closer, tolerance)
        })
    })?;
    fits(&seen.wide, &one_from_other).then(|| {
        let [forth, back] = [seen.forth, seen.back].map(|matches| matches.found);
        let links = [
            Link { models: [one.index, other.index], pairs: forth },
            Link { models: [other.index, one.index], pairs: back },
        ];
        (one_from_other, links)
    })
}

/// What the comparisons have found.
struct Seen {
    /// Matches of the last round in the views of the second model, and in those of the first.
    forth: Matches,
    back: Matches,
    /// Matches of a wide search in the views of the second model. A wrong similarity then also has matches far away,
    /// which lower the share of those that fit.
    wide: Matches,
}

/// Repeats the comparison with large pictures until the similarity has settled.
fn converge(
    one: &mut Held,
    other: &mut Held,
    start: &Similarity,
    tolerance: fn(f64) -> Tolerance,
) -> Option<(Similarity, Seen)> {
    let mut one_from_other = *start;
    let views = [other.views(one, start), one.views(other, &start.inverse())];
    let (mut last, mut wide) = (None, None);
    for (round, (reach_px, tolerance_px)) in ROUNDS.into_iter().enumerate() {
        let forth = look(other, one, &views[0], &one_from_other, SIZE_PX, reach_px);
        let back = look(one, other, &views[1], &one_from_other.inverse(), SIZE_PX, reach_px);
        let mut pairs = forth.found.clone();
        pairs.extend(back.swapped().found);
        let found = agreed(&pairs, tolerance(tolerance_px))?;
        let change_px = change_px(&pairs, &found, &one_from_other);
        one_from_other = found;
        if round == 0 && change_px < NEAR_PX {
            wide = Some(forth.clone());
        }
        last = Some((forth, back));
        if change_px < SETTLED_PX {
            break;
        }
    }
    let (forth, back) = last?;
    let wide = wide.unwrap_or_else(|| look(other, one, &views[0], &one_from_other, SIZE_PX, ROUNDS[0].0));
    Some((one_from_other, Seen { forth, back, wide }))
}

/// Brings two models that are far apart closer to each other.
fn approach(
    one: &mut Held,
    other: &mut Held,
    start: &Similarity,
    tolerance: fn(f64) -> Tolerance,
) -> Option<Similarity> {
    let mut one_from_other = *start;
    for (size_px, reach_px, tolerance_px) in FAR_ROUNDS {
        let views = other.views(one, &one_from_other);
        let seen = look(other, one, &views, &one_from_other, size_px, reach_px);
        one_from_other = agreed(&seen.found, tolerance(tolerance_px))?;
    }
    Some(one_from_other)
}

/// The similarity with which most pairs agree; `None` if too few agree.
fn agreed(pairs: &[Pair], tolerance: Tolerance) -> Option<Similarity> {
    let (found, agreeing) = consensus(pairs, tolerance)?;
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

/// Searches patches of `trusted` in `views` of `other`. `from_other` moves these cameras into the frame of `trusted`, so
/// that both models are rendered from the same place.
fn look(
    other: &mut Held,
    trusted: &mut Held,
    views: &[Camera],
    from_other: &Similarity,
    size_px: u32,
    reach_px: usize,
) -> Matches {
    let mut seen = Matches::default();
    for camera in views {
        let camera = resized(camera, size_px);
        let shown = Sight::of(&mut trusted.renderer, from_other.camera(&camera));
        let there = Sight::of(&mut other.renderer, camera);
        seen.extend(matches(&shown, &trusted.cameras, &there, reach_px));
    }
    seen
}

fn resized(camera: &Camera, size_px: u32) -> Camera {
    camera.fitted(size_px)
}

/// Whether enough patches were searched and found, and enough matches fit.
fn fits(seen: &Matches, one_from_other: &Similarity) -> bool {
    let (found, fit) = (seen.found.len() as f64, Tolerance::in_pictures(FIT_PX));
    let near = seen.found.iter().filter(|pair| fit.holds(pair, one_from_other)).count() as f64;
    seen.sought >= SOUGHT_MIN
        && found >= FOUND_SHARE_MIN * seen.sought as f64
        && near >= FIT_SHARE_MIN * found
}

#[cfg(test)]
pub(super) mod tests;
