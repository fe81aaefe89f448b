//! Finds the similarity transform that most pairs of points agree with (RANSAC).

use glam::DVec3;

use super::matching::Pair;
use super::similarity::Similarity;

/// Number of random triples of pairs that are tried.
const TRIES: usize = 400;
/// How often the best similarity is fitted again to all pairs that agree with it.
const REFITS: usize = 5;
/// Accepted scales of a similarity, as multiples of the ratio of the widths of a pixel in the two models.
const SCALES: std::ops::RangeInclusive<f64> = 0.5..=2.0;

/// The similarity from the other model's frame to the trusted model's frame with which most pairs agree, and the number
/// of these pairs. A pair agrees if its points are at most `tolerance_px` apart ([`distance_px`]). `None` if fewer than
/// three pairs agree.
pub(super) fn consensus(pairs: &[Pair], tolerance_px: f64) -> Option<(Similarity, usize)> {
    let mut dice = Dice(pairs.len() as u64);
    let mut best: Option<(Similarity, usize)> = None;
    for _ in 0..if pairs.len() < 3 { 0 } else { TRIES } {
        let triple = [(); 3].map(|()| pairs[dice.below(pairs.len())]);
        let pixels = triple[0].trusted_pixel_m / triple[0].other_pixel_m;
        let Some(found) = between(&triple).filter(|found| SCALES.contains(&(found.scale / pixels))) else {
            continue;
        };
        let count = count_agreeing(pairs, &found, tolerance_px);
        if count >= 3 && best.is_none_or(|(_, most)| count > most) {
            best = Some((found, count));
        }
    }
    let (mut found, _) = best?;
    for _ in 0..REFITS {
        found = between(&agreeing(pairs, &found, tolerance_px)).unwrap_or(found);
    }
    Some((found, count_agreeing(pairs, &found, tolerance_px)))
}

/// Distance between the two points of a pair after `from_other` has moved the other model's point, in pixels of the
/// trusted model's picture.
pub(super) fn distance_px(pair: &Pair, from_other: &Similarity) -> f64 {
    from_other.apply(pair.other).distance(pair.trusted) / pair.trusted_pixel_m
}

/// The pairs whose points are at most `tolerance_px` apart after `from_other` has moved the other model's points.
pub(super) fn agreeing(pairs: &[Pair], from_other: &Similarity, tolerance_px: f64) -> Vec<Pair> {
    pairs.iter().filter(|pair| distance_px(pair, from_other) <= tolerance_px).copied().collect()
}

/// The number of these pairs.
pub(super) fn count_agreeing(pairs: &[Pair], from_other: &Similarity, tolerance_px: f64) -> usize {
    pairs.iter().filter(|pair| distance_px(pair, from_other) <= tolerance_px).count()
}

/// The similarity that moves the other model's points closest to the trusted model's.
pub(super) fn between(pairs: &[Pair]) -> Option<Similarity> {
    let (other, trusted): (Vec<DVec3>, Vec<DVec3>) =
        pairs.iter().map(|pair| (pair.other, pair.trusted)).unzip();
    Similarity::between(&other, &trusted)
}

/// Random numbers from a seed (SplitMix64).
pub(super) struct Dice(pub(super) u64);

impl Dice {
    /// 64 random bits.
    pub(super) fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// A number from 0 to below `end`, which must not be 0.
    pub(super) fn below(&mut self, end: usize) -> usize {
        (self.bits() % end as u64) as usize
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::similarity::tests::wrong;
    use super::*;

    #[test]
    fn the_similarity_is_found_although_a_third_of_the_pairs_are_wrong() {
        let mut dice = Dice(1);
        let mut point = || DVec3::from_array([(); 3].map(|()| dice.below(1000) as f64 / 10.0));
        let pairs: Vec<Pair> = (0..120)
            .map(|i| {
                let other = point();
                let trusted = if i % 3 == 0 { point() } else { wrong().apply(other) };
                Pair {
                    trusted,
                    other,
                    trusted_pixel_m: 0.1,
                    other_pixel_m: 0.1,
                    trusted_sight: DVec3::ZERO,
                    other_sight: DVec3::ZERO,
                }
            })
            .collect();
        let (found, count) = consensus(&pairs, 1.0).unwrap();
        assert_eq!(count, 80);
        assert!(found.apply(DVec3::ONE).distance(wrong().apply(DVec3::ONE)) < 1e-9, "{found:?}");
        assert!(consensus(&pairs[..2], 1.0).is_none());
    }
}
