//! One affine colour per model: every drone's camera chooses exposure and white balance for itself, and where two of
//! them meet a seam would stay.
//!
//! Models are compared where their surfaces agree ([`Glimpse`]): of each pair, mean and spread of the colours that both
//! show. Gains, then offsets, are those with which all pairs agree best, weighted by their pixels, and which leave the
//! models on the whole as they are. Models that were compressed before they were sent are compared with nobody (Caliterra
//! at 240 px then had 32.95 instead of 33.81 dB). Where nobody differs by more than training leaves between models of one camera
//! anyway, nobody is changed.

use std::collections::BTreeMap;
use std::fmt;

use cosurf_engine::Renderer;
use cosurf_scene::Splats;
use cosurf_scene::splats::SH_C0;
use serde::{Deserialize, Serialize};

use super::glimpse::Glimpse;
use super::similarity::solve;
use crate::merge::{Locals, MergeError};

/// How far mean colours of a pair, and the |ln| of the ratio of their spreads, must be apart for any model to be changed. Those
/// of one camera are by up to 0.024 and 0.13 where it chose its exposures (real Caliterra, four agents), by 0.004 and
/// 0.008 where it did not (rendered Boruszyn).
const MEANS_MIN: f64 = 0.03;
const SPREADS_MIN: f64 = 0.2;
/// Colours that vary less tell no gain.
const SPREAD_MIN: f64 = 0.03;
/// How strongly models hold to their own colours: far less than one shared picture does, enough for those that share
/// nothing.
const HOLD: f64 = 1e-6;

/// `c ↦ gain c + offset`, by channel.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Tone {
    /// Red, green, blue; positive.
    pub gain: [f64; 3],
    /// Red, green, blue.
    pub offset: [f64; 3],
}

impl Tone {
    /// Of splats: a colour is 0.5 and the sum of its harmonics, of which the first is constant.
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

/// What two models show of the same places.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Shared {
    count: f64,
    /// By model and channel.
    sums: [[f64; 3]; 2],
    squares: [[f64; 3]; 2],
}

impl Shared {
    pub(super) fn note(&mut self, colors: [[f32; 3]; 2]) {
        self.count += 1.0;
        for ((sums, squares), color) in self.sums.iter_mut().zip(&mut self.squares).zip(colors) {
            for (channel, value) in color.into_iter().map(f64::from).enumerate() {
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

    /// ln of how much more the second model's colours vary; 0 where that cannot be told.
    fn log_ratio(&self, channel: usize) -> f64 {
        let spreads = [0, 1].map(|model| self.spread(model, channel));
        if spreads.iter().all(|spread| *spread >= SPREAD_MIN) { (spreads[1] / spreads[0]).ln() } else { 0.0 }
    }

    /// Whether the two are those of one camera, as far as training lets them be.
    fn agrees(&self) -> bool {
        (0..3).all(|channel| {
            (self.mean(0, channel) - self.mean(1, channel)).abs() < MEANS_MIN
                && self.log_ratio(channel).abs() < SPREADS_MIN
        })
    }
}

/// By what the colours of each of `locals` are to be changed, in their order; `None` where nobody's are.
pub(super) fn tones(
    locals: &dyn Locals,
    threads: usize,
    is_given_up: &dyn Fn() -> bool,
) -> Result<Option<Vec<Tone>>, MergeError> {
    let pairs = compare(locals, threads, is_given_up)?;
    let agree_already = pairs.values().all(Shared::agrees);
    Ok((!agree_already).then(|| agree(&pairs, locals.count())))
}

/// What is shared by which models, the lower first.
type Pairs = BTreeMap<[usize; 2], Shared>;

fn compare(locals: &dyn Locals, threads: usize, is_given_up: &dyn Fn() -> bool) -> Result<Pairs, MergeError> {
    let mut pairs = Pairs::new();
    if locals.count() < 2 {
        return Ok(pairs);
    }
    let mut shown = Vec::with_capacity(locals.count());
    for i in 0..locals.count() {
        let model = locals.load(i)?;
        shown.push(Glimpse::some(&model.splats, &model.cameras, false, threads));
    }
    for i in 0..locals.count() {
        if is_given_up() {
            return Err(MergeError::GivenUp);
        }
        let model = locals.load(i)?;
        let mut renderer = None;
        // Where one has left ground to the other, what both show is what neither shows well.
        let is_told = |other: usize| other != i && !locals.is_compressed(i) && !locals.is_compressed(other);
        for (other, glimpses) in shown.iter().enumerate().filter(|(other, _)| is_told(*other)) {
            for glimpse in glimpses {
                let Some(places) = glimpse.shared_with(&model.cameras) else { continue };
                let renderer = renderer.get_or_insert_with(|| Renderer::new(&model.splats, threads));
                for [theirs, its] in glimpse.colors_with(renderer, &places) {
                    let (pair, colors) =
                        if i < other { ([i, other], [its, theirs]) } else { ([other, i], [theirs, its]) };
                    pairs.entry(pair).or_default().note(colors);
                }
            }
        }
    }
    Ok(pairs)
}

/// The tones with which all pairs agree best.
fn agree(pairs: &Pairs, count: usize) -> Vec<Tone> {
    let mut tones = vec![Tone { gain: [1.0; 3], offset: [0.0; 3] }; count];
    for channel in 0..3 {
        let ratio = |_, shared: &Shared| shared.log_ratio(channel);
        for (tone, gain) in tones.iter_mut().zip(balance(pairs, count, ratio)) {
            tone.gain[channel] = gain.exp();
        }
        // A pair's models are as bright as each other when their offsets differ by what is left between them.
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

/// One number per model so that those of a pair `[a, b]` differ by `difference`, `x_a − x_b`, as nearly as can be,
/// weighted by pixels; on the whole they are 0.
fn balance(pairs: &Pairs, count: usize, difference: impl Fn([usize; 2], &Shared) -> f64) -> Vec<f64> {
    let all: f64 = pairs.values().map(|shared| shared.count).sum();
    let mut matrix = vec![vec![0.0; count]; count];
    let mut right = vec![vec![0.0]; count];
    (0..count).for_each(|i| matrix[i][i] = HOLD * all.max(1.0));
    for (&[a, b], shared) in pairs {
        let weight = shared.count;
        matrix[a][a] += weight;
        matrix[b][b] += weight;
        matrix[a][b] -= weight;
        matrix[b][a] -= weight;
        right[a][0] += weight * difference([a, b], shared);
        right[b][0] -= weight * difference([a, b], shared);
    }
    solve(matrix, right).into_iter().map(|row| row[0]).collect()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::admit;
    use super::super::tests::flights;
    use super::*;
    use crate::testing::{InMemory, above};

    fn tones_of(locals: &InMemory) -> Option<Vec<Tone>> {
        tones(locals, 1, &|| false).unwrap()
    }

    /// A model as a camera of another exposure makes it.
    fn exposed(locals: &mut InMemory, model: usize, gain: [f64; 3], offset: [f64; 3]) {
        Tone { gain, offset }.apply(&mut locals.0[model].splats);
    }

    #[test]
    fn models_of_one_camera_stay_as_they_are() {
        assert_eq!(tones_of(&InMemory(flights())), None);
        assert_eq!(tones_of(&InMemory(flights()[..1].to_vec())), None);
    }

    #[test]
    fn an_exposure_of_its_own_is_found_and_shared_out() {
        let mut locals = InMemory(flights());
        exposed(&mut locals, 1, [0.7, 0.8, 0.9], [0.05, 0.0, -0.02]);
        let tones = tones_of(&locals).unwrap();
        let by = [[0.7, 0.05], [0.8, 0.0], [0.9, -0.02]];
        for (channel, [gain, offset]) in by.into_iter().enumerate() {
            let total = tones.iter().map(|tone| tone.gain[channel].ln()).sum::<f64>();
            assert!(total.abs() < 1e-4, "gains are 1 on the whole: {tones:?}");
            for other in [0, 2, 3] {
                let found = tones[1].gain[channel] / tones[other].gain[channel];
                assert!((found * gain - 1.0).abs() < 0.02, "channel {channel}: {tones:?}");
                // A grey of the others as this model shows it, and as both show it afterwards.
                let its = tones[1].gain[channel] * (gain * 0.5 + offset) + tones[1].offset[channel];
                let theirs = tones[other].gain[channel] * 0.5 + tones[other].offset[channel];
                assert!((its - theirs).abs() < 0.01, "channel {channel}: {its} and {theirs}");
            }
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
        let admitted = admit(&locals, false, 1, &|| false).unwrap();
        assert_eq!(admitted.count(), 4, "another exposure is no contradiction");
        assert!(difference(&locals) > 0.08, "{}", difference(&locals));
        assert!(difference(&admitted) < 0.01, "{}", difference(&admitted));
        assert!(admitted.place(2).tone.is_some());
    }

    #[test]
    fn who_shares_nothing_keeps_its_colours() {
        let mut locals = InMemory(flights());
        locals.0.push(super::super::tests::flight(60.0));
        exposed(&mut locals, 0, [0.7; 3], [0.0; 3]);
        let alone = tones_of(&locals).unwrap()[4];
        assert!(alone.gain.iter().all(|gain| (gain - 1.0).abs() < 1e-9), "{alone:?}");
        assert!(alone.offset.iter().all(|offset| offset.abs() < 1e-9), "{alone:?}");
    }
}
