//! Finds how two models in unrelated frames lie to each other, from places that both show ([`super::features`]).
//!
//! Each place of one model is matched to the place of the other model whose descriptor is most like its own. Most of
//! these matches are wrong. Right ones agree on one similarity, and each of them also tells its scale: the ratio of the
//! widths of a pixel. The similarity with which most matches agree is only a first guess, which the caller must verify.

use glam::DVec3;
use rayon::prelude::*;

use super::consensus::{Dice, Tolerance, agreeing, between, count_agreeing};
use super::features::Feature;
use super::matching::Pair;
use super::similarity::Similarity;

/// Least likeness of two places that may be the same.
const LIKENESS_MIN: f32 = 0.8;
/// Places of a model within this distance of each other are seen as one place, px.
const SAME_PX: f64 = 6.0;
/// A match counts only if the angle to the best descriptor is at most this share of the angle to the best descriptor of
/// another place (Lowe: 0.8 of the distances).
const RATIO_MAX: f32 = 0.9;
/// Number of random triples of matches that are tried.
const TRIES: usize = 40_000;
/// Largest ratio between two scales of one similarity: neighbouring sizes of pictures differ by 1.4.
const SCALES_APART_MAX: f64 = 1.5;
/// Largest distance between matched places that agree, px.
const AGREE_PX: f64 = 6.0;
/// Least number of matches that must agree.
const AGREEING_MIN: usize = 10;

/// A guess of the similarity from the frame of `other` to that of `one`; `None` if too few places match.
pub(super) fn register(one: &[Feature], other: &[Feature]) -> Option<Similarity> {
    let pairs = matched(one, other);
    let mut dice = Dice(pairs.len() as u64);
    let mut best: Option<(usize, Similarity)> = None;
    for _ in 0..TRIES {
        let Some(guess) = triple(&pairs, &mut dice) else { continue };
        let count = count_agreeing(&pairs, &guess, Tolerance::in_space(AGREE_PX));
        if best.is_none_or(|(most, _)| count > most) {
            best = Some((count, guess));
        }
    }
    let (_, mut found) = best?;
    for _ in 0..5 {
        found = between(&agreeing(&pairs, &found, Tolerance::in_space(AGREE_PX))).unwrap_or(found);
    }
    (count_agreeing(&pairs, &found, Tolerance::in_space(AGREE_PX)) >= AGREEING_MIN).then_some(found)
}

/// Each place of `other` with the place of `one` that is most like it, if no other place is almost as like.
fn matched(one: &[Feature], other: &[Feature]) -> Vec<Pair> {
    let find = |feature: &Feature| {
        let likeness: Vec<f32> = one.iter().map(|candidate| candidate.likeness(feature)).collect();
        let best = (0..one.len()).reduce(|a, b| if likeness[b] > likeness[a] { b } else { a })?;
        let is_elsewhere =
            |i: &usize| one[*i].at.distance(one[best].at) > SAME_PX * one[best].pixel_m.max(one[*i].pixel_m);
        let second = (0..one.len()).filter(is_elsewhere).map(|i| likeness[i]).fold(-1.0, f32::max);
        let angle = |likeness: f32| libm::acosf(likeness.clamp(-1.0, 1.0));
        let is_clear = likeness[best] >= LIKENESS_MIN && angle(likeness[best]) <= RATIO_MAX * angle(second);
        is_clear.then(|| Pair {
            trusted: one[best].at,
            other: feature.at,
            trusted_pixel_m: one[best].pixel_m,
            other_pixel_m: feature.pixel_m,
            trusted_sight: DVec3::ZERO,
            other_sight: DVec3::ZERO,
        })
    };
    other.par_iter().filter_map(find).collect()
}

/// The similarity between three random pairs, if their distances and the widths of their pixels tell the same scale.
fn triple(pairs: &[Pair], dice: &mut Dice) -> Option<Similarity> {
    if pairs.len() < 3 {
        return None;
    }
    let chosen = [(); 3].map(|()| pairs[dice.below(pairs.len())]);
    let scale_of = |pair: &Pair| pair.trusted_pixel_m / pair.other_pixel_m;
    let scales = chosen.each_ref().map(scale_of);
    let sides = [[0, 1], [1, 2], [0, 2]].map(|[a, b]| {
        let far = |of: fn(&Pair) -> DVec3| of(&chosen[a]).distance(of(&chosen[b]));
        let (trusted, other) = (far(|pair| pair.trusted), far(|pair| pair.other));
        // Three places close together would not fix a rotation.
        (trusted > 20.0 * chosen[a].trusted_pixel_m).then_some(trusted / other)
    });
    let [Some(a), Some(b), Some(c)] = sides else { return None };
    let all = [a, b, c, scales[0], scales[1], scales[2]];
    let (least, most) = all.into_iter().fold((f64::INFINITY, 0.0f64), |(l, m), v| (l.min(v), m.max(v)));
    (most <= SCALES_APART_MAX * least).then(|| between(&chosen))?
}
