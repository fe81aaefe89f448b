//! Matches the models' colours by one affine transform of the colours for each model. Every drone's camera chooses its
//! own exposure and white balance, which would otherwise leave a seam where two models meet.
//!
//! Two models are compared where their surfaces agree ([`Glimpse`]), by the mean and the spread (standard deviation) of
//! the colours that both show there. Gains, and then offsets, are chosen so that all pairs of models agree best. Each
//! pair is weighted by its number of pixels, and the median model stays unchanged. Models pruned before upload are
//! not compared, as that makes the result worse. No model is changed if no pair differs by more than two models of the
//! same camera do.

use std::collections::BTreeMap;
use std::fmt;

use cosurf_scene::Splats;
use cosurf_scene::splats::SH_C0;
use serde::{Deserialize, Serialize};

#[cfg(doc)]
use super::glimpse::Glimpse;
use super::similarity::solve;

/// Colours are changed only if a pair of models differs by at least this much in a mean colour, or by [`SPREADS_MIN`].
/// Models of the same camera differ by less, even if the camera varied its exposure.
const MEANS_MIN: f64 = 0.03;
/// Colours are changed only if a pair of models differs by at least this much in |ln| of the ratio of their spreads, or
/// by [`MEANS_MIN`].
const SPREADS_MIN: f64 = 0.2;
/// Least spread (standard deviation) of colours from which a gain can be derived.
const SPREAD_MIN: f64 = 0.03;
/// The contrasts of two models are compared only if the brightness of one correlates with that of the other at least so
/// well.
const ALIKE_MIN: f64 = 0.9;
/// Weight with which a model keeps its own colours, as a share of all compared pixels. It is negligible beside one
/// shared picture, but fixes the colours of a model that shares none.
const OWN_WEIGHT: f64 = 1e-6;
/// Rounds in which colours are matched. After each, pairs that still differ count less: a model that is brighter at one end
/// than at the other fits no other model, and must not change the colours of those that fit each other.
const ROUNDS: usize = 8;
/// A pair that still differs by this much, in a colour or in the logarithm of a gain, counts half.
const RESIDUAL: f64 = 0.01;

/// A change of colours: each channel `c` becomes `gain · c + offset`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Tone {
    /// Factors for red, green, blue; positive.
    pub gain: [f64; 3],
    /// What is added to red, green, blue, for colours in 0..=1.
    pub offset: [f64; 3],
}

impl Tone {
    /// Changes the colours of splats. A colour is 0.5 plus the sum of its spherical harmonics. Only the first harmonic
    /// is constant, so it takes the offset.
    pub(super) fn apply(&self, splats: &mut Splats) {
        let stride = splats.sh_stride();
        for sh in splats.sh.chunks_exact_mut(stride) {
            for (k, value) in sh.iter_mut().enumerate() {
                let (gain, offset) = (self.gain[k % 3], self.offset[k % 3]);
                let shift = if k < 3 { (0.5 * (gain - 1.0) + offset) / f64::from(SH_C0) } else { 0.0 };
                *value = (gain * f64::from(*value) + shift) as f32;
            }
        }
    }
}

impl fmt::Display for Tone {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ([r, g, b], [dr, dg, db]) = (self.gain, self.offset);
        write!(f, "colours × {r:.2} {g:.2} {b:.2} {dr:+.2} {dg:+.2} {db:+.2}")
    }
}

/// How many times as strong the contrast of the first model is as that of the second. `colors` are those of both at the same
/// points of the surface. The result is 1 where the contrasts differ no more than those of models of one camera do, are too small to
/// tell, or belong to different patterns. A model that shows less detail has almost the same contrast, as the points are far
/// apart.
pub(super) fn contrast(colors: &[[[f32; 3]; 2]]) -> f64 {
    let grey = |color: [f32; 3]| color.iter().map(|value| f64::from(*value)).sum::<f64>() / 3.0;
    let greys: Vec<[f64; 2]> = colors.iter().map(|pair| pair.map(grey)).collect();
    let count = greys.len().max(1) as f64;
    let means = [0, 1].map(|model| greys.iter().map(|pair| pair[model]).sum::<f64>() / count);
    let product = |a: usize, b: usize| {
        greys.iter().map(|pair| (pair[a] - means[a]) * (pair[b] - means[b])).sum::<f64>() / count
    };
    let [first, second] = [0, 1].map(|model| product(model, model).sqrt());
    let is_told = first.min(second) > SPREAD_MIN
        && libm::log(first / second).abs() >= SPREADS_MIN
        && product(0, 1) >= ALIKE_MIN * first * second;
    if is_told { first / second } else { 1.0 }
}

/// Sums over the colours that two models show of the same surface points.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Shared {
    count: f64,
    /// Sums of colours, `[model, channel]`.
    sums: [[f64; 3]; 2],
    /// Sums of squared colours, `[model, channel]`.
    squares: [[f64; 3]; 2],
    /// Sums of products of both models' colours, `[channel]`.
    products: [f64; 3],
}

impl Shared {
    /// Notes the colours of both models at a point or, on average, in a part of the surface.
    pub(super) fn note<T: Copy + Into<f64>>(&mut self, colors: [[T; 3]; 2]) {
        let colors = colors.map(|rgb| rgb.map(Into::into));
        self.count += 1.0;
        (0..3).for_each(|channel| self.products[channel] += colors[0][channel] * colors[1][channel]);
        for ((sums, squares), color) in self.sums.iter_mut().zip(&mut self.squares).zip(colors) {
            for (channel, value) in color.into_iter().enumerate() {
                sums[channel] += value;
                squares[channel] += value * value;
            }
        }
    }

    fn mean(&self, model: usize, channel: usize) -> f64 {
        self.sums[model][channel] / self.count
    }

    fn spread(&self, model: usize, channel: usize) -> f64 {
        (self.squares[model][channel] / self.count - self.mean(model, channel).powi(2)).max(0.0).sqrt()
    }

    /// Natural logarithm of the ratio of the spreads, second model to first; 0 if the colours vary too little.
    fn log_ratio(&self, channel: usize) -> f64 {
        let spreads = [0, 1].map(|model| self.spread(model, channel));
        if spreads.iter().all(|spread| *spread >= SPREAD_MIN) {
            libm::log(spreads[1] / spreads[0])
        } else {
            0.0
        }
    }

    /// Mean square of the difference that is left if one model gets the mean and the spread of the other.
    pub(super) fn left(&self) -> f64 {
        let left = |channel: usize| {
            let means = self.mean(0, channel) * self.mean(1, channel);
            let covariance = self.products[channel] / self.count - means;
            2.0 * (self.spread(0, channel) * self.spread(1, channel) - covariance).max(0.0)
        };
        (0..3).map(left).sum::<f64>() / 3.0
    }

    /// Whether the colours of the two models differ no more than those of two models of the same camera.
    fn agrees(&self) -> bool {
        (0..3).all(|channel| {
            (self.mean(0, channel) - self.mean(1, channel)).abs() < MEANS_MIN
                && self.log_ratio(channel).abs() < SPREADS_MIN
        })
    }
}

/// The colours in which each pair of models shows the same surface, lower index first.
#[derive(Clone, Debug, Default)]
pub(super) struct Pairs(BTreeMap<[usize; 2], Shared>);

impl Pairs {
    /// Notes the colours of some surface points: of the model with the index `one`, then of the model `other`.
    pub(super) fn note(&mut self, one: usize, other: usize, colors: impl Iterator<Item = [[f32; 3]; 2]>) {
        for [a, b] in colors {
            let (pair, colors) = if one < other { ([one, other], [a, b]) } else { ([other, one], [b, a]) };
            self.0.entry(pair).or_default().note(colors);
        }
    }

    /// The pairs of the models with the indices `kept`, ascending. They are numbered anew in that order.
    fn of(&self, kept: &[usize]) -> Self {
        let place = |model: &usize| kept.binary_search(model).ok();
        let pairs = self.0.iter().filter_map(|([a, b], shared)| Some(([place(a)?, place(b)?], *shared)));
        Self(pairs.collect())
    }
}

/// The change of colours for each of the models with the indices `taking_part`, ascending; `None` if no change is
/// needed.
pub(super) fn tones(colors: &Pairs, taking_part: &[usize]) -> Option<Vec<Tone>> {
    let pairs = colors.of(taking_part);
    let agree_already = pairs.0.values().all(Shared::agrees);
    (!agree_already).then(|| agree(&pairs, taking_part.len()))
}

/// The [`Tone`] of each model with which all pairs agree best.
fn agree(pairs: &Pairs, count: usize) -> Vec<Tone> {
    let mut tones = vec![Tone { gain: [1.0; 3], offset: [0.0; 3] }; count];
    for channel in 0..3 {
        let ratio = |_, shared: &Shared| shared.log_ratio(channel);
        for (tone, gain) in tones.iter_mut().zip(balance(pairs, count, ratio)) {
            tone.gain[channel] = libm::exp(gain);
        }
        // Two models are equally bright if the difference of their offsets makes up for the difference that the gains
        // leave between their means.
        let gains: Vec<f64> = tones.iter().map(|tone| tone.gain[channel]).collect();
        let left = |[a, b]: [usize; 2], shared: &Shared| {
            gains[b] * shared.mean(1, channel) - gains[a] * shared.mean(0, channel)
        };
        for (tone, offset) in tones.iter_mut().zip(balance(pairs, count, left)) {
            tone.offset[channel] = offset;
        }
    }
    tones
}

/// Finds one number `x` for each model, weighted by pixels: for each pair `[a, b]`, `x_a − x_b` comes as close as possible
/// to `difference`. Pairs that fit no solution count less ([`ROUNDS`]). The median of the compared models is 0, so that one
/// odd model does not change the others; a model that was not compared has 0.
fn balance(pairs: &Pairs, count: usize, difference: impl Fn([usize; 2], &Shared) -> f64) -> Vec<f64> {
    let all: f64 = pairs.0.values().map(|shared| shared.count).sum();
    let mut found: Option<Vec<f64>> = None;
    for _ in 0..ROUNDS {
        let mut matrix = vec![vec![0.0; count]; count];
        let mut right = vec![vec![0.0]; count];
        (0..count).for_each(|i| matrix[i][i] = OWN_WEIGHT * all.max(1.0));
        for (&[a, b], shared) in &pairs.0 {
            let difference = difference([a, b], shared);
            let left = found.as_ref().map_or(0.0, |found| found[a] - found[b] - difference);
            let weight = shared.count / (1.0 + (left / RESIDUAL).powi(2));
            matrix[a][a] += weight;
            matrix[b][b] += weight;
            matrix[a][b] -= weight;
            matrix[b][a] -= weight;
            right[a][0] += weight * difference;
            right[b][0] -= weight * difference;
        }
        found = Some(solve(matrix, right).into_iter().map(|row| row[0]).collect());
    }
    let found = found.unwrap_or_default();
    let is_compared = |i: &usize| pairs.0.keys().any(|pair| pair.contains(i));
    let middle = middle((0..count).filter(is_compared).map(|i| found[i]).collect());
    (0..count).map(|i| if is_compared(&i) { found[i] - middle } else { 0.0 }).collect()
}

/// The median; of an even number of values, the mean of the two in the middle. 0 of no values.
fn middle(mut values: Vec<f64>) -> f64 {
    values.sort_unstable_by(f64::total_cmp);
    let count = values.len();
    if count == 0 { 0.0 } else { 0.5 * (values[(count - 1) / 2] + values[count / 2]) }
}

#[cfg(test)]
mod contrast_tests {
    use super::contrast;

    /// Colours of two models. The contrast of the second is that of the first times this factor.
    fn colors(factor: f32) -> Vec<[[f32; 3]; 2]> {
        (0..100).map(|i| i as f32 / 100.0).map(|grey| [[grey; 3], [0.1 + factor * grey; 3]]).collect()
    }

    #[test]
    fn contrasts_of_other_cameras_are_undone_and_small_differences_are_none() {
        assert!((contrast(&colors(0.6)) * 0.6 - 1.0).abs() < 1e-3);
        assert!((contrast(&colors(1.7)) * 1.7 - 1.0).abs() < 1e-3);
        assert_eq!([contrast(&colors(0.9)), contrast(&colors(0.0)), contrast(&[])], [1.0; 3]);
        let mut others = colors(0.6);
        others.iter_mut().step_by(2).for_each(|pair| pair[1] = [0.9 - pair[1][0]; 3]);
        assert_eq!(contrast(&others), 1.0, "another pattern has no contrast to compare");
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::admit;
    use super::super::chosen::fixed;
    use super::super::judge::judge;
    use super::super::tests::{UNMOVED, flights};
    use cosurf_engine::Renderer;

    use super::*;
    use crate::gate::tests::workspace;
    use crate::merge::shifts::Shifts;
    use crate::merge::{InMemory, Locals};
    use crate::testing::above;

    fn tones_of(locals: &InMemory) -> Option<Vec<Tone>> {
        let (choosers, scratch) = (fixed(locals.count()), std::env::temp_dir());
        let colors = judge(locals, &choosers, &[], Shifts::PAIR, &scratch, &|| false).unwrap().colors;
        tones(&colors, &(0..locals.count()).collect::<Vec<_>>())
    }

    /// Changes the colours of a model as another exposure of its camera would.
    fn exposed(locals: &mut InMemory, model: usize, gain: [f64; 3], offset: [f64; 3]) {
        Tone { gain, offset }.apply(&mut locals.0[model].splats);
    }

    #[test]
    fn models_of_one_camera_keep_their_colours() {
        assert_eq!(tones_of(&InMemory(flights())), None);
        assert_eq!(tones_of(&InMemory(flights()[..1].to_vec())), None);
    }

    #[test]
    fn one_models_exposure_is_found_and_the_others_stay() {
        let mut locals = InMemory(flights());
        exposed(&mut locals, 1, [0.7, 0.8, 0.9], [0.05, 0.0, -0.02]);
        let tones = tones_of(&locals).unwrap();
        let by = [[0.7, 0.05], [0.8, 0.0], [0.9, -0.02]];
        for (channel, [gain, offset]) in by.into_iter().enumerate() {
            for other in [0, 2, 3] {
                assert!((tones[other].gain[channel] - 1.0).abs() < 0.02, "the others stay: {tones:?}");
                assert!(tones[other].offset[channel].abs() < 0.01, "the others stay: {tones:?}");
                let found = tones[1].gain[channel] / tones[other].gain[channel];
                assert!((found * gain - 1.0).abs() < 0.02, "channel {channel}: {tones:?}");
                // Mid grey of the other model, as model 1 shows it. After the change of colours, both must show it
                // alike.
                let its = tones[1].gain[channel] * (gain * 0.5 + offset) + tones[1].offset[channel];
                let theirs = tones[other].gain[channel] * 0.5 + tones[other].offset[channel];
                assert!((its - theirs).abs() < 0.01, "channel {channel}: {its} and {theirs}");
            }
        }
    }

    #[test]
    fn a_model_that_fits_no_other_does_not_change_those_that_fit() {
        // Model 3 is brighter the farther east it looks, and each other model shares another part with it.
        let greys = || (0..100).map(|i| 0.3 + 0.004 * i as f32);
        let mut pairs = Pairs::default();
        for [one, other, brighter] in [[0, 1, 0], [0, 2, 0], [1, 2, 0], [0, 3, -2], [1, 3, 0], [2, 3, 2]] {
            let colors = greys().map(|grey| [[grey; 3], [grey + 0.1 * brighter as f32; 3]]);
            pairs.note(one as usize, other as usize, colors);
        }
        let tones = tones(&pairs, &[0, 1, 2, 3]).unwrap();
        for tone in &tones[..3] {
            assert!(tone.offset.iter().all(|offset| offset.abs() < 0.01), "{tones:?}");
        }
    }

    #[test]
    fn admitted_models_show_shared_ground_in_one_colour() {
        let mut locals = InMemory(flights());
        exposed(&mut locals, 2, [0.75; 3], [0.0; 3]);
        let difference = |locals: &dyn Locals| {
            let shown =
                [1, 2].map(|i| Renderer::new(&locals.load(i).unwrap().splats, 1).render(&above(9.0)).rgb);
            let sum: f32 = shown[0].iter().zip(&shown[1]).map(|(a, b)| (a - b).abs()).sum();
            sum / shown[0].len() as f32
        };
        let admitted = admit(&locals, UNMOVED, workspace(&std::env::temp_dir()), &|| false).unwrap();
        assert_eq!(admitted.count(), 4, "another exposure is no contradiction");
        assert!(difference(&locals) > 0.08, "{}", difference(&locals));
        assert!(difference(&admitted) < 0.01, "{}", difference(&admitted));
        assert!(admitted.place(2).tone.is_some());
    }

    #[test]
    fn a_model_that_shares_no_ground_keeps_its_colours() {
        let mut locals = InMemory(flights());
        locals.0.push(super::super::tests::flight(60.0));
        exposed(&mut locals, 0, [0.7; 3], [0.0; 3]);
        let alone = tones_of(&locals).unwrap()[4];
        assert!(alone.gain.iter().all(|gain| (gain - 1.0).abs() < 1e-9), "{alone:?}");
        assert!(alone.offset.iter().all(|offset| offset.abs() < 1e-9), "{alone:?}");
    }
}
