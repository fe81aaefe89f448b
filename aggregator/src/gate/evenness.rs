//! Measures how far two models differ in colours that vary slowly: one of them may be brighter at one end than at the
//! other, or from some sides only. One change of all colours ([`tone`](super::tone)) does not mend that, and fine detail
//! ([`quality`](super::quality)) does not show it. In place of one of four honest models, a model that is 0.2 brighter at
//! one end than at the other cost rendered Boruszyn 1.7 dB more than without it.

use std::collections::BTreeMap;

use super::quality::Differences;

/// Side of the blocks over which colours are averaged, pixels of a glimpse.
const BLOCK_PX: usize = 8;
/// A block counts if the models show the same surface in at least so many of its pixels.
const SAME_PX_MIN: usize = 16;
/// Difference of colours, for colours in 0..=1, that counts as much as fine detail that differs by its own strength. Honest
/// models differ by 0.009 to 0.024 (root mean square) in three missions, which [`Differences`] takes for no error.
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

/// Sums over blocks of two models.
#[derive(Default)]
struct Pair {
    pictures: usize,
    blocks: f64,
    /// Sums of colours, `[model, channel]`.
    sums: [[f64; 3]; 2],
    /// Sums of squared colours, `[model, channel]`.
    squares: [[f64; 3]; 2],
    /// Sums of products of both models' colours, `[channel]`.
    products: [f64; 3],
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
            let colors = if one < other { [a, b] } else { [b, a] };
            pair.blocks += 1.0;
            for channel in 0..3 {
                for model in 0..2 {
                    pair.sums[model][channel] += colors[model][channel];
                    pair.squares[model][channel] += colors[model][channel].powi(2);
                }
                pair.products[channel] += colors[0][channel] * colors[1][channel];
            }
        }
    }

    /// How much each pair of models differs beyond one gain and one offset of all colours.
    pub(super) fn differences(&self) -> Differences {
        let mut differences = Differences::default();
        for ([one, other], pair) in &self.0 {
            let left = pair.left() / UNIT.powi(2);
            (0..pair.pictures).for_each(|_| differences.note(*one, *other, left));
        }
        differences
    }
}

impl Pair {
    /// Mean square of the difference that is left if one model gets the mean and the spread of the other.
    fn left(&self) -> f64 {
        let mean = |model: usize, channel: usize| self.sums[model][channel] / self.blocks;
        let variance = |model: usize, channel: usize| {
            (self.squares[model][channel] / self.blocks - mean(model, channel).powi(2)).max(0.0)
        };
        let left = |channel: usize| {
            let product = self.products[channel] / self.blocks - mean(0, channel) * mean(1, channel);
            2.0 * ((variance(0, channel) * variance(1, channel)).sqrt() - product).max(0.0)
        };
        (0..3).map(left).sum::<f64>() / 3.0
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
