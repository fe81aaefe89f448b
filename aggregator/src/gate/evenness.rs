//! Measures how far two models differ in colours that vary slowly: one of them may be brighter at one end than at the
//! other, or from some sides only. One change of all colours ([`tone`](super::tone)) does not mend that, and fine detail
//! ([`quality`](super::quality)) does not show it. In place of one of four honest models, a model that is 0.2 brighter at
//! one end than at the other cost rendered Boruszyn 1.7 dB more than without it.

use std::collections::BTreeMap;

use super::quality::Differences;
use super::tone::Shared;

/// Side of the blocks over which colours are averaged, pixels of a glimpse.
const BLOCK_PX: usize = 8;
/// A block counts if the models show the same surface in at least so many of its pixels.
const SAME_PX_MIN: usize = 16;
/// Colours in 0..=1 that differ by this much (root mean square) count as a difference of 1 in [`Differences`]. The models of
/// three honest missions differ by 0.009 to 0.024, too little to count.
const UNIT: f64 = 0.075;

/// Mean colours of two models in the blocks of a picture. `colors` has the place of each pixel, and the colours of both.
pub(super) fn blocks(colors: impl Iterator<Item = ([usize; 2], [[f32; 3]; 2])>) -> Vec<[[f64; 3]; 2]> {
    let mut blocks: BTreeMap<[usize; 2], (usize, [[f64; 3]; 2])> = BTreeMap::new();
    for (place, colors) in colors {
        let (count, sums) = blocks.entry(place.map(|at| at / BLOCK_PX)).or_default();
        *count += 1;
        for (sum, value) in sums.as_flattened_mut().iter_mut().zip(colors.as_flattened()) {
            *sum += f64::from(*value);
        }
    }
    let whole = blocks.into_values().filter(|(count, _)| *count >= SAME_PX_MIN);
    whole.map(|(count, sums)| sums.map(|rgb| rgb.map(|sum| sum / count as f64))).collect()
}

/// The colours of each pair of models in all blocks, lower index first.
#[derive(Default)]
pub(super) struct Evenness(BTreeMap<[usize; 2], Pair>);

/// The colours of two models in some blocks.
#[derive(Default)]
struct Pair {
    pictures: usize,
    blocks: Shared,
}

impl Evenness {
    /// Notes the blocks of a picture: colours of the model `one`, then of the model `other`.
    pub(super) fn note(&mut self, one: usize, other: usize, blocks: &[[[f64; 3]; 2]]) {
        if blocks.is_empty() {
            return;
        }
        let pair = self.0.entry([one.min(other), one.max(other)]).or_default();
        pair.pictures += 1;
        for [a, b] in blocks {
            pair.blocks.note(if one < other { [*a, *b] } else { [*b, *a] });
        }
    }

    /// How much each pair of models differs beyond one gain and one offset of all colours.
    pub(super) fn differences(&self) -> Differences {
        let mut differences = Differences::default();
        for ([one, other], pair) in &self.0 {
            let left = pair.blocks.left() / UNIT.powi(2);
            (0..pair.pictures).for_each(|_| differences.note(*one, *other, left));
        }
        differences
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The colours of two models in a picture of 64 × 64 pixels. `one` and `other` give them for places in 0..=1.
    fn picture(one: impl Fn(f64) -> f64, other: impl Fn(f64) -> f64) -> Vec<[[f64; 3]; 2]> {
        let pixels = (0..64 * 64).map(|i| [i % 64, i / 64]);
        let ground = |[x, y]: [usize; 2]| 0.2 * f64::from(u8::from((x / 8 + y / 8) % 2 == 0));
        let colors = |place: [usize; 2]| {
            let x = place[0] as f64 / 63.0;
            let scene = 0.4 + ground(place);
            [scene * (1.0 + one(x)), scene * (1.0 + other(x))].map(|grey| [grey as f32; 3])
        };
        blocks(pixels.map(|place| (place, colors(place))))
    }

    /// What each of four models counts, if the last one is brighter by `odd` of its colour.
    fn weights(odd: impl Fn(f64) -> f64 + Copy) -> Vec<f64> {
        let mut evenness = Evenness::default();
        for one in 0..4 {
            for other in one + 1..4 {
                let own = |model: usize, x: f64| 0.02 * model as f64 * (6.0 * x).sin();
                let brighter =
                    |model: usize| move |x: f64| own(model, x) + if model == 3 { odd(x) } else { 0.0 };
                evenness.note(one, other, &picture(brighter(one), brighter(other)));
            }
        }
        evenness.differences().standards(4, |_| true).iter().map(|standard| standard.weight()).collect()
    }

    #[test]
    fn another_exposure_counts_fully_and_a_ramp_hardly_counts() {
        assert_eq!(weights(|_| 0.0), [1.0; 4]);
        assert_eq!(weights(|_| 0.3), [1.0; 4], "tones mend it");
        assert_eq!(weights(|x| 0.05 * (x - 0.5)), [1.0; 4], "a camera may vary its exposure");
        let found = weights(|x| 0.5 * (x - 0.5));
        assert!(found[..3] == [1.0; 3] && found[3] < 0.1, "{found:?}");
    }

    #[test]
    fn blocks_with_few_pixels_of_the_same_surface_do_not_count() {
        let pixels = |count: usize| (0..count).map(|i| ([i % 8, i / 8], [[0.1; 3], [0.9; 3]]));
        assert!(blocks(pixels(SAME_PX_MIN - 1)).is_empty());
        assert_eq!(blocks(pixels(SAME_PX_MIN)).len(), 1);
        let mut evenness = Evenness::default();
        evenness.note(0, 1, &[]);
        assert!(
            evenness.differences().standards(2, |_| true).iter().all(|standard| standard.weight() == 1.0)
        );
    }
}
