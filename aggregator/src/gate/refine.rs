//! Where a model belongs that lies in another frame than the others: turned, scaled and moved to where what it shows
//! of common ground lies with what a trusted model shows.
//!
//! Patches of what one shows are looked for in what the other shows ([`super::matching`]); pairs of points in space
//! come of it, and the similarity that most of them agree with ([`super::consensus`]). It is found in rounds, from
//! small pictures, in which much of them is searched, to larger ones. What does not come to lie together is not moved.

use cosurf_engine::Renderer;
use cosurf_scene::Camera;

use super::consensus::{consensus, distance_px};
use super::matching::{Matches, Sight, matches};
use super::similarity::Similarity;
use crate::merge::{Locals, MergeError};

/// Points lie together up to this distance, in pixels of the pictures compared. Where right models of real drone
/// pictures overlap (Caliterra at 240 px, four agents), three quarters of the pairs are less than 0.9 px apart, and
/// 0.48 to 0.65 of the patches are found.
const FIT_PX: f64 = 2.0;
/// Share of the patches found that must lie together, and of those looked for that must be found.
const FIT_SHARE_MIN: f64 = 0.5;
const FOUND_SHARE_MIN: f64 = 0.2;
/// Patches that must have been looked for.
const SOUGHT_MIN: usize = 24;
/// Pairs that must agree with a similarity, and their share of those found.
const AGREEING_MIN: usize = 8;
const AGREEING_SHARE_MIN: f64 = 0.3;
/// Share of a picture that both models must show.
const SHARED_MIN: f64 = 0.15;
/// Cameras of the model through which the two are compared.
const VIEWS: usize = 8;
/// Long side of the pictures in which common ground is looked for, px.
const SCOUT_PX: u32 = 48;
/// Long side of the largest pictures compared, px.
const SIZE_PX: u32 = 320;
/// Long side of the pictures, reach of the search, and tolerance of agreement of each round, px: at first a frame may
/// be off by almost half the picture.
const ROUNDS: [(u32, usize, f64); 5] =
    [(80, 40, 3.0), (160, 20, 3.0), (SIZE_PX, 12, 3.0), (SIZE_PX, 6, 2.0), (SIZE_PX, 4, 1.5)];
/// Those in which it is compared with all.
const LAST_ROUNDS: [(u32, usize, f64); 2] = [(SIZE_PX, 4, 1.5), (SIZE_PX, 4, 1.5)];

/// The similarity that takes the model `other` to where it fits the model `trusted`, if there is one.
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

/// The same more exactly: where the model `other`, which `from_other` takes to where it fits, fits all of `trusted` best.
/// On Caliterra (240 px, four agents) what a single one leaves is up to 0.4 % of the extent.
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

/// A model at hand.
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

/// Looks for what `trusted` shows in what `other` shows its own cameras, if the latter is moved by `from_other`.
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

/// Whether enough was found, and enough of it lies together.
fn fits(seen: &Matches, from_other: &Similarity) -> bool {
    let found = seen.found.len() as f64;
    let near = seen.found.iter().filter(|pair| distance_px(pair, from_other) <= FIT_PX).count() as f64;
    seen.sought >= SOUGHT_MIN
        && found >= FOUND_SHARE_MIN * seen.sought as f64
        && near >= FIT_SHARE_MIN * found
}

#[cfg(test)]
mod tests;
