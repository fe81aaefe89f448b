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

/// How far the two points of a pair that agrees may be apart.
#[derive(Clone, Copy, Debug)]
pub(super) struct Tolerance {
    /// Largest distance, pixels of the trusted model's picture.
    px: f64,
    /// How far the part of it along the line of sight counts, 0 to 1.
    depth_share: f64,
}

impl Tolerance {
    /// How far a distance along the line of sight counts where pictures tell it worse than a distance across. Of two models
    /// of the city that were ingested apart, 35 % of the matches agree if it counts in full, and 69 % if it counts so (200
    /// steps, 240 px, held-out views 19 dB).
    const DEPTH_SHARE: f64 = 0.25;

    /// Distances of at most `px`, whatever their direction.
    pub(super) fn in_space(px: f64) -> Self {
        Self { px, depth_share: 1.0 }
    }

    /// Distances along the line of sight may be longer than `px`.
    pub(super) fn in_pictures(px: f64) -> Self {
        Self { px, depth_share: Self::DEPTH_SHARE }
    }

    /// Whether a pair agrees after `from_other` has moved the other model's point.
    pub(super) fn holds(&self, pair: &Pair, from_other: &Similarity) -> bool {
        let apart = from_other.apply(pair.other) - pair.trusted;
        let along = apart.dot(pair.trusted_sight) * pair.trusted_sight;
        (apart - (1.0 - self.depth_share) * along).length() <= self.px * pair.trusted_pixel_m
    }
}

/// The similarity from the other model's frame to the trusted model's frame with which most pairs agree, and the number
/// of these pairs. `None` if fewer than
/// three pairs agree.
pub(super) fn consensus(pairs: &[Pair], tolerance: Tolerance) -> Option<(Similarity, usize)> {
    let mut dice = Dice(pairs.len() as u64);
    let mut best: Option<(Similarity, usize)> = None;
    for _ in 0..if pairs.len() < 3 { 0 } else { TRIES } {
        let triple = [(); 3].map(|()| pairs[dice.below(pairs.len())]);
        let pixels = triple[0].trusted_pixel_m / triple[0].other_pixel_m;
        let Some(found) = between(&triple).filter(|found| SCALES.contains(&(found.scale / pixels))) else {
            continue;
        };
        let count = count_agreeing(pairs, &found, tolerance);
        if count >= 3 && best.is_none_or(|(_, most)| count > most) {
            best = Some((found, count));
        }
    }
    let (mut found, _) = best?;
    for _ in 0..REFITS {
        found = between(&agreeing(pairs, &found, tolerance)).unwrap_or(found);
    }
    Some((found, count_agreeing(pairs, &found, tolerance)))
}

/// The pairs that agree after `from_other` has moved the other model's points.
pub(super) fn agreeing(pairs: &[Pair], from_other: &Similarity, tolerance: Tolerance) -> Vec<Pair> {
    pairs.iter().filter(|pair| tolerance.holds(pair, from_other)).copied().collect()
}

/// The number of these pairs.
pub(super) fn count_agreeing(pairs: &[Pair], from_other: &Similarity, tolerance: Tolerance) -> usize {
    pairs.iter().filter(|pair| tolerance.holds(pair, from_other)).count()
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
        let (found, count) = consensus(&pairs, Tolerance::in_space(1.0)).unwrap();
        assert_eq!(count, 80);
        assert!(found.apply(DVec3::ONE).distance(wrong().apply(DVec3::ONE)) < 1e-9, "{found:?}");
        assert!(consensus(&pairs[..2], Tolerance::in_space(1.0)).is_none());
    }

    #[test]
    fn depths_may_be_worse_than_places_in_pictures() {
        let mut dice = Dice(2);
        let mut share = || dice.below(1001) as f64 / 1000.0 - 0.5;
        let pairs: Vec<Pair> = (0..120)
            .map(|_| {
                let other = DVec3::new(100.0 * share(), 100.0 * share(), 10.0 * share());
                let sight = DVec3::new(share(), share(), -2.0).normalize();
                // Up to 8 pixels along the sight, and 0.5 pixels across.
                let off = 16.0 * share() * sight + DVec3::new(share(), share(), 0.0);
                Pair {
                    trusted: other + 0.1 * off,
                    other,
                    trusted_pixel_m: 0.1,
                    other_pixel_m: 0.1,
                    trusted_sight: sight,
                    other_sight: sight,
                }
            })
            .collect();
        let agreeing = |tolerance| consensus(&pairs, tolerance).unwrap().1;
        let [lenient, strict] = [Tolerance::in_pictures(2.0), Tolerance::in_space(2.0)].map(agreeing);
        assert!(lenient > 90 && strict < 60, "{lenient}, {strict}");
    }
}
