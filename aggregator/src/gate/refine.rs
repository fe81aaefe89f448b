//! Finds where a model from another frame belongs. Rotates, scales and moves the model until the ground that it shares
//! with a trusted model lies at the same place in both.
//!
//! Patches of the trusted model's pictures are searched in pictures of the other model ([`super::matching`]). The
//! matches give pairs of points in space, and the similarity is chosen with which most pairs agree
//! ([`super::consensus`]). This is repeated in rounds. The first rounds use small pictures and a wide search, the later
//! ones larger pictures. A model that does not fit after the last round is not moved.

use cosurf_engine::Renderer;
use cosurf_scene::Camera;

use super::consensus::{consensus, distance_px};
use super::matching::{Matches, Sight, matches};
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
/// A camera of the other model is used only if at least this share of its picture shows ground that the trusted model's
/// own cameras see.
const SHARED_MIN: f64 = 0.15;
/// Limit on the number of cameras through which two models are compared.
const VIEWS: usize = 8;
/// Long side of the pictures that measure how much ground two models share, px.
const SCOUT_PX: u32 = 48;
/// Long side of the largest pictures that are compared, px.
const SIZE_PX: u32 = 320;
/// Three numbers for each round, px: the long side of the pictures, the reach of the search, and the tolerance of
/// agreement. In the first round, the models may be almost half a picture apart.
const ROUNDS: [(u32, usize, f64); 5] =
    [(80, 40, 3.0), (160, 20, 3.0), (SIZE_PX, 12, 3.0), (SIZE_PX, 6, 2.0), (SIZE_PX, 4, 1.5)];
/// The rounds that compare with all trusted models: the long side of the pictures, the reach of the search, and the
/// tolerance of agreement, px.
const LAST_ROUNDS: [(u32, usize, f64); 2] = [(SIZE_PX, 4, 1.5), (SIZE_PX, 4, 1.5)];

/// The similarity that moves the model `other` to where it fits the model `trusted`; `None` if the model fits nowhere.
pub(super) fn refine(
    locals: &dyn Locals,
    other: usize,
    trusted: usize,
    threads: usize,
) -> Result<Option<Similarity>, MergeError> {
    let mut other = Held::of(locals, other, threads)?;
    let mut trusted = Held::of(locals, trusted, threads)?;
    let mut from_other = Similarity::IDENTITY;
    for (size_px, reach_px, tolerance_px) in ROUNDS {
        let seen = look(&mut other, &mut trusted, &from_other, size_px, reach_px);
        let Some((found, agreeing)) = consensus(&seen.found, tolerance_px) else { return Ok(None) };
        if agreeing < AGREEING_MIN || (agreeing as f64) < AGREEING_SHARE_MIN * seen.found.len() as f64 {
            return Ok(None);
        }
        from_other = found;
    }
    let (size_px, reach_px, _) = ROUNDS[2];
    let seen = look(&mut other, &mut trusted, &from_other, size_px, reach_px);
    Ok(fits(&seen, &from_other).then_some(from_other))
}

/// Improves the similarity `from_other`, which was found with one trusted model, by fitting the model `other` to all of
/// `trusted`. With a single trusted model, a small error is left.
pub(super) fn refine_against_all(
    locals: &dyn Locals,
    other: usize,
    trusted: &[usize],
    from_other: Similarity,
    threads: usize,
) -> Result<Similarity, MergeError> {
    let mut other = Held::of(locals, other, threads)?;
    let mut from_other = from_other;
    for (size_px, reach_px, tolerance_px) in LAST_ROUNDS {
        let mut seen = Matches::default();
        for trusted in trusted {
            let mut trusted = Held::of(locals, *trusted, threads)?;
            seen.extend(look(&mut other, &mut trusted, &from_other, size_px, reach_px));
        }
        match consensus(&seen.found, tolerance_px) {
            Some((found, agreeing)) if agreeing >= AGREEING_MIN => from_other = found,
            _ => break,
        }
    }
    Ok(from_other)
}

/// The cameras of a loaded model, and its renderer.
struct Held {
    cameras: Vec<Camera>,
    renderer: Renderer,
}

impl Held {
    fn of(locals: &dyn Locals, local: usize, threads: usize) -> Result<Self, MergeError> {
        let model = locals.load(local)?;
        Ok(Self { cameras: model.cameras, renderer: Renderer::new(&model.splats, threads) })
    }
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
    let mut shares: Vec<(f64, Camera)> = Vec::with_capacity(other.cameras.len());
    for camera in &other.cameras {
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
fn fits(seen: &Matches, from_other: &Similarity) -> bool {
    let found = seen.found.len() as f64;
    let near = seen.found.iter().filter(|pair| distance_px(pair, from_other) <= FIT_PX).count() as f64;
    seen.sought >= SOUGHT_MIN
        && found >= FOUND_SHARE_MIN * seen.sought as f64
        && near >= FIT_SHARE_MIN * found
}

#[cfg(test)]
mod tests;
