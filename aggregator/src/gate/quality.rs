//! Measures how far each model is from the truth, by how much it differs from the others where they show the same
//! ground. What a device says of its own model does not count.
//!
//! Two models differ in fine detail by the error of the one plus the error of the other. If several models differ from
//! one model, but not from each other, the error is that model's own.
//!
//! If no three models were compared with each other, directly or in a longer ring of an odd number of models, the
//! differences do not tell which of them are to blame. Then small errors are blamed on nobody, and large errors on as
//! few models as possible.
//!
//! Models that hardly differ from each other, beside how far they differ from the rest, are copies or parts of one model. They
//! count as one, or they would outvote the others.

use std::collections::BTreeMap;

use cosurf_engine::Renderer;
use cosurf_scene::Camera;
use serde::{Deserialize, Serialize};

use super::frames::groups;
use super::glimpse::median;
use super::similarity::solve;

/// Long side of the pictures, px.
const SIZE_PX: u32 = 192;
/// Detail is what differs from the mean of the pixels within this distance, px along each axis.
const DETAIL_PX: usize = 4;
/// Weight with which an error is drawn to 0. It is small beside one comparison, and makes one model with large errors
/// more likely than several.
const SMALL_WEIGHT: f64 = 0.01;

/// Rounds in which the errors are found. After each, pairs that do not fit count less: a model may differ from one other
/// model far more than from the rest, and that model is not to blame.
const ROUNDS: usize = 12;
/// A pair that was compared in more pictures counts no more than with this many: a model that claims the cameras of another
/// one is compared with it in most.
const PICTURES_FULL: f64 = 4.0;
/// Differences that the errors explain up to this much count fully.
const RESIDUAL: f64 = 0.03;

/// Two models are copies of one model if they differ at most by this share of what either differs from other models. Honest
/// models differ at least by a third of that.
const COPY_SHARE: f64 = 0.25;

/// Errors up to this many times as large as those of the others do not count against a model. Errors of honest models
/// are up to 1.8 times as large in rendered missions, and 2.34 times in a real one, Caliterra.
const FAIR_TIMES: f64 = 2.4;
/// A model with errors more than this many times as large as those of the others may be far worse.
const FAR_WORSE_TIMES: f64 = 4.0;
/// A model is far worse only if its error is above this. The error of a model without detail, or with detail of
/// something else, is 2.
const FAR_WORSE_MIN: f64 = 1.0;
/// Smaller errors count as this one. The models of a mission with many steps have errors of 0.01 to 0.06, and none of them
/// is poor.
const ERROR_MIN: f64 = 0.04;
/// What an observation counts falls with this power of the error. With the second power, a model of rendered Boruszyn with
/// faint splats cost 1.9 dB more than without it; with the fourth, 0.1.
const WEIGHT_POWER: i32 = 4;

/// The fine detail of a model in the picture of a camera.
#[derive(Serialize, Deserialize)]
pub(super) struct Detail {
    /// `[height, width]`: grey values without their local mean.
    fine: Vec<f32>,
    size_px: [usize; 2],
}

impl Detail {
    pub(super) fn of(renderer: &mut Renderer, camera: &Camera) -> Self {
        let camera = camera.fitted(SIZE_PX);
        let rgb = renderer.render_colors(&camera);
        let grey: Vec<f32> = rgb.chunks_exact(3).map(|rgb| (rgb[0] + rgb[1] + rgb[2]) / 3.0).collect();
        let size_px = camera.size_px.map(|side| side as usize);
        Self { fine: without_local_mean(&grey, size_px), size_px }
    }

    /// Multiplies the contrast of the detail.
    pub(super) fn times(mut self, contrast: f64) -> Self {
        self.fine.iter_mut().for_each(|value| *value *= contrast as f32);
        self
    }

    /// Mean squared difference of two models' detail in a picture, as a share of its mean square. `shared` are pixels
    /// of a glimpse of the same camera, of the size `of_px`; only detail inside them counts.
    pub(super) fn difference(&self, other: &Self, shared: &[usize], of_px: [u32; 2]) -> Option<f64> {
        assert_eq!(self.size_px, other.size_px, "details are compared in pictures of one size");
        let [width, height] = self.size_px;
        let [across, down] = of_px.map(|side| side as usize);
        let (mut difference, mut square) = (0.0, 0.0);
        for &i in shared {
            let (x, y) = (i % across, i / across);
            for v in y * height / down..(y + 1) * height / down {
                for u in x * width / across..(x + 1) * width / across {
                    let [a, b] = [self, other].map(|detail| f64::from(detail.fine[v * width + u]));
                    difference += (a - b).powi(2);
                    square += 0.5 * (a * a + b * b);
                }
            }
        }
        (square > 0.0).then(|| difference / square)
    }
}

/// Grey values minus the mean of those within [`DETAIL_PX`] along each axis.
fn without_local_mean(grey: &[f32], [width, height]: [usize; 2]) -> Vec<f32> {
    let around = |at: usize, side: usize| at.saturating_sub(DETAIL_PX)..(at + DETAIL_PX + 1).min(side);
    let across = |row: &[f32]| -> Vec<f32> {
        let mean = |x: usize| {
            let near = &row[around(x, width)];
            near.iter().sum::<f32>() / near.len() as f32
        };
        (0..width).map(mean).collect()
    };
    let rows: Vec<f32> = grey.chunks_exact(width).flat_map(across).collect();
    let mut fine = grey.to_vec();
    let mut sums = vec![0.0; width];
    for (y, row) in fine.chunks_exact_mut(width).enumerate() {
        sums.fill(0.0);
        let near = around(y, height);
        for v in near.clone() {
            sums.iter_mut().zip(&rows[v * width..]).for_each(|(sum, value)| *sum += value);
        }
        row.iter_mut().zip(&sums).for_each(|(grey, sum)| *grey -= sum / near.len() as f32);
    }
    fine
}

/// How much the models of each pair differ, lower index first: the sum over the compared pictures, and their number.
#[derive(Default)]
pub(super) struct Differences(BTreeMap<[usize; 2], (f64, f64)>);

impl Differences {
    pub(super) fn note(&mut self, one: usize, other: usize, difference: f64) {
        self.add([one.min(other), one.max(other)], (difference, 1.0));
    }

    fn add(&mut self, pair: [usize; 2], found: (f64, f64)) {
        let (sum, count) = self.0.entry(pair).or_default();
        *sum += found.0;
        *count += found.1;
    }

    /// The standard of each of `count` models beside those of the others. Only models that are `sound` count.
    pub(super) fn standards(&self, count: usize, sound: impl Fn(usize) -> bool) -> Vec<Standard> {
        let pairs = self.0.iter().filter(|(pair, _)| pair.iter().all(|model| sound(*model)));
        let of_sound = Self(pairs.map(|(pair, found)| (*pair, *found)).collect());
        of_sound.standards_of_all(count)
    }

    /// The standards of all models, where copies of one model count as one.
    fn standards_of_all(&self, count: usize) -> Vec<Standard> {
        let mut originals: Vec<usize> = (0..count).collect();
        let mut apart = Self(self.0.clone());
        while let Some([original, copy]) = apart.closest_copies() {
            originals.iter_mut().filter(|its| **its == copy).for_each(|its| *its = original);
            apart = self.of_originals(&originals);
        }
        let standards = apart.standards_of_each(count);
        originals.iter().map(|original| standards[*original]).collect()
    }

    /// Of the pairs of models that are copies, the one that differs least. Two of three models are never taken for copies: the
    /// third may differ from both because it is wrong.
    fn closest_copies(&self) -> Option<[usize; 2]> {
        let differences = |model: usize, but: [usize; 2]| {
            let its = self.0.iter().filter(move |(pair, _)| pair.contains(&model) && **pair != but);
            its.map(|(_, found)| mean(*found)).collect::<Vec<f64>>()
        };
        let are_copies = |pair: &[usize; 2]| {
            pair.iter().all(|model| {
                let mut others = differences(*model, *pair);
                others.sort_unstable_by(f64::total_cmp);
                others.len() > 1 && mean(self.0[pair]) <= COPY_SHARE * others[(others.len() - 1) / 2]
            })
        };
        let pairs = self.0.keys().filter(|pair| are_copies(pair)).copied();
        pairs.min_by(|a, b| mean(self.0[a]).total_cmp(&mean(self.0[b])))
    }

    /// The differences of models without copies. `originals` has, for each model, the index of the one that it is a copy of,
    /// or its own.
    fn of_originals(&self, originals: &[usize]) -> Self {
        let mut apart = Self::default();
        for (pair, found) in &self.0 {
            let [a, b] = pair.map(|model| originals[model]);
            if a != b {
                apart.add([a.min(b), a.max(b)], *found);
            }
        }
        apart
    }

    /// The standard of each of `count` models, none of which is a copy.
    fn standards_of_each(&self, count: usize) -> Vec<Standard> {
        let errors = self.errors(count);
        let is_determined = self.determined(count);
        let groups = groups(self.0.keys().copied(), count);
        let standard = |i: usize| {
            // Models elsewhere, that share no ground with it, do not tell what is usual here.
            let is_near = |j: &usize| *j != i && groups[*j] == groups[i];
            let mut others: Vec<f64> = (0..count).filter(is_near).filter_map(|j| errors[j]).collect();
            let Some(error) = errors[i].filter(|_| !others.is_empty()) else { return Standard::UNKNOWN };
            let standard = Standard { error, times: error / median(&mut others).max(ERROR_MIN) };
            if is_determined[i] || standard.is_far_worse() { standard } else { Standard::UNKNOWN }
        };
        (0..count).map(standard).collect()
    }

    /// Whether the differences determine the error of each of `count` models: whether some ring of an odd number of
    /// compared models is connected with it.
    fn determined(&self, count: usize) -> Vec<bool> {
        // Models and their mirror images: a comparison leads from a model to the image of the other one. A model is
        // connected with its own image only by way of an odd ring.
        let pairs = self.0.keys().flat_map(|&[a, b]| [[a, b + count], [a + count, b]]);
        let groups = groups(pairs, 2 * count);
        (0..count).map(|i| groups[i] == groups[i + count]).collect()
    }

    /// The error of each of `count` models: its share of the mean square of the detail; `None` for a model that was not
    /// compared with any other.
    fn errors(&self, count: usize) -> Vec<Option<f64>> {
        let mut errors = vec![0.0; count];
        let mut weights: BTreeMap<[usize; 2], f64> = self.0.keys().map(|pair| (*pair, 1.0)).collect();
        for _ in 0..ROUNDS {
            errors = self.fitted(count, &weights);
            for (pair, weight) in &mut weights {
                let (sum, pictures) = self.0[pair];
                let residual = errors[pair[0]] + errors[pair[1]] - sum / pictures;
                *weight = RESIDUAL / residual.abs().max(RESIDUAL);
            }
        }
        let is_compared = |i: &usize| self.0.keys().any(|pair| pair.contains(i));
        (0..count).map(|i| is_compared(&i).then_some(errors[i])).collect()
    }

    /// The errors that fit the differences best, where each pair of models counts as much as its weight.
    fn fitted(&self, count: usize, weights: &BTreeMap<[usize; 2], f64>) -> Vec<f64> {
        let mut matrix = vec![vec![0.0; count]; count];
        let mut right = vec![vec![0.0]; count];
        (0..count).for_each(|i| matrix[i][i] = SMALL_WEIGHT);
        for (pair, (sum, pictures)) in &self.0 {
            let weight = weights[pair] * pictures.min(PICTURES_FULL);
            for [i, j] in [[pair[0], pair[1]], [pair[1], pair[0]]] {
                matrix[i][i] += weight;
                matrix[i][j] += weight;
                right[i][0] += weight * sum / pictures;
            }
        }
        solve(matrix, right).into_iter().map(|row| row[0].max(0.0)).collect()
    }
}

fn mean((sum, pictures): (f64, f64)) -> f64 {
    sum / pictures
}

/// How good a model is beside the others.
#[derive(Clone, Copy, Debug)]
pub(super) struct Standard {
    /// Error of the model.
    error: f64,
    /// The error, divided by the median error of the others.
    pub(super) times: f64,
}

impl Standard {
    /// For a model that was not compared with any other.
    const UNKNOWN: Self = Self { error: 0.0, times: 1.0 };

    /// Whether the model must not take part.
    pub(super) fn is_far_worse(&self) -> bool {
        self.error > FAR_WORSE_MIN && self.times > FAR_WORSE_TIMES
    }

    /// What the model's observations count, 0..=1.
    pub(super) fn weight(&self) -> f64 {
        (FAIR_TIMES / self.times).min(1.0).powi(WEIGHT_POWER)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The differences of models with these errors, all of which were compared with each other.
    fn differences(errors: &[f64]) -> Differences {
        let mut differences = Differences::default();
        for (i, one) in errors.iter().enumerate() {
            (0..i).for_each(|j| differences.note(i, j, one + errors[j]));
        }
        differences
    }

    #[test]
    fn the_error_of_each_model_is_found_from_the_differences_of_pairs() {
        let right = [0.2, 0.15, 0.25, 1.4, 0.2];
        for (found, right) in differences(&right).errors(6).into_iter().zip(right) {
            assert!(found.is_some_and(|found| (found - right).abs() < 0.02), "{found:?} {right}");
        }
        assert_eq!(differences(&right).errors(6)[5], None, "it was not compared");
    }

    #[test]
    fn if_all_differ_from_one_model_the_error_is_its_own() {
        let mut differences = Differences::default();
        (1..5).for_each(|i| differences.note(0, i, 1.5));
        let errors: Vec<f64> = differences.errors(5).into_iter().flatten().collect();
        assert!(errors[0] > 1.1 && errors[1..].iter().all(|error| *error < 0.4), "{errors:?}");
    }

    #[test]
    fn a_worse_model_counts_less_and_a_far_worse_one_is_refused() {
        let standards = |errors: &[f64]| differences(errors).standards(errors.len(), |_| true);
        let good = standards(&[0.03, 0.06, 0.025, 0.05]);
        assert!(good.iter().all(|standard| standard.weight() == 1.0), "{good:?}");
        let blurred = standards(&[0.03, 0.03, 0.3, 0.03]);
        assert!(blurred[2].weight() < 0.15 && !blurred[2].is_far_worse(), "{blurred:?}");
        let lost = standards(&[0.2, 0.2, 1.3, 0.2]);
        assert!(lost[2].is_far_worse() && !lost[0].is_far_worse(), "{lost:?}");
        let two = standards(&[0.2, 1.6]);
        assert!(two.iter().all(counts_fully), "nobody knows which of two is worse: {two:?}");
    }

    /// Three uploads of one model differ from one of the others more than is usual, as the model itself does.
    #[test]
    fn parts_or_copies_of_a_model_do_not_outvote_the_others() {
        let all = |copies: usize, of_copies: f64| {
            let mut all = differences(&[0.07, 0.04, 0.05]);
            for copy in 3..3 + copies {
                [0.15, 0.08, 0.09]
                    .into_iter()
                    .enumerate()
                    .for_each(|(i, differs)| all.note(i, copy, differs));
                (3..copy).for_each(|other| all.note(other, copy, of_copies));
            }
            all.standards(3 + copies, |_| true)
        };
        for standards in [all(1, 0.0), all(3, 0.0), all(3, 0.01), all(8, 0.0)] {
            assert!(standards.iter().all(counts_fully), "{standards:?}");
        }
        let mut liars = differences(&[0.05; 3]);
        for copy in 3..6 {
            (0..3).for_each(|i| liars.note(i, copy, 0.7));
            (3..copy).for_each(|other| liars.note(other, copy, 0.02));
        }
        let standards = liars.standards(6, |_| true);
        assert!(standards[..3].iter().all(counts_fully), "{standards:?}");
        assert!(standards[3..].iter().all(|standard| standard.weight() < 0.1), "{standards:?}");
    }

    fn counts_fully(standard: &Standard) -> bool {
        standard.weight() == 1.0 && !standard.is_far_worse()
    }

    /// A dishonest model differs far more from the one whose ground it claims than from the others.
    #[test]
    fn a_model_that_one_poor_model_differs_from_most_is_not_blamed() {
        let mut all = Differences::default();
        for _ in 0..4 {
            differences(&[0.04, 0.04, 0.05, 0.04, 0.2])
                .0
                .into_iter()
                .for_each(|([i, j], (sum, _))| all.note(i, j, sum));
        }
        (0..12).for_each(|_| all.note(0, 4, 0.9));
        let standards = all.standards(5, |_| true);
        assert!(standards[..4].iter().all(counts_fully), "{standards:?}");
        assert!(standards[4].weight() < 0.5, "{standards:?}");
    }

    #[test]
    fn nobody_is_blamed_for_small_differences_that_do_not_tell_who_is_worse() {
        for of_leaves in [vec![0.12, 0.06, 0.06], vec![0.10, 0.06, 0.06], vec![0.06; 6], vec![0.4; 6]] {
            let mut star = Differences::default();
            of_leaves.iter().enumerate().for_each(|(i, difference)| star.note(0, i + 1, *difference));
            let standards = star.standards(of_leaves.len() + 1, |_| true);
            assert!(standards.iter().all(counts_fully), "{standards:?}");
        }
        let mut ring = Differences::default();
        (0..4).for_each(|i| ring.note(i, (i + 1) % 4, 0.3));
        assert!(ring.standards(4, |_| true).iter().all(counts_fully));
        ring.note(0, 2, 0.3);
        ring.note(0, 1, 3.0);
        ring.note(0, 3, 3.0);
        ring.note(0, 2, 3.0);
        let standards = ring.standards(4, |_| true);
        assert!(standards[0].weight() < 0.5, "with a diagonal, the differences tell: {standards:?}");
    }

    #[test]
    fn models_that_share_no_ground_with_a_model_do_not_change_what_it_counts() {
        let ring = |differences: &mut Differences, first: usize, errors: [f64; 3]| {
            for (i, j) in [(0, 1), (1, 2), (0, 2)] {
                differences.note(first + i, first + j, errors[i] + errors[j]);
            }
        };
        let (mut alone, mut both) = (Differences::default(), Differences::default());
        ring(&mut alone, 3, [0.1, 0.12, 0.7]);
        ring(&mut both, 3, [0.1, 0.12, 0.7]);
        ring(&mut both, 0, [0.02, 0.02, 0.02]);
        let [alone, both] = [alone, both].map(|differences| differences.standards(6, |_| true));
        for i in 3..6 {
            let (a, b) = (alone[i].weight(), both[i].weight());
            assert!((a - b).abs() < 1e-9, "model {i} counts {a} alone, and {b} beside others far away");
        }
        assert!(alone[5].weight() < 0.5, "a poor model counts less: {alone:?}");
    }

    #[test]
    fn a_refused_model_does_not_make_others_look_worse() {
        let mut star = Differences::default();
        for (leaf, difference) in [(1, 0.1), (2, 0.1), (3, 4.0)] {
            star.note(0, leaf, difference);
        }
        let standards = star.standards(4, |i| i != 3);
        assert!(standards.iter().all(counts_fully), "{standards:?}");
    }
}
