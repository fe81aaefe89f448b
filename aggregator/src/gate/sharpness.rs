//! Measures how fine the detail is that each model shows, beside the others. Whoever claims larger pictures or nearer
//! cameras than it had must show finer detail where other models show the same ground. Otherwise its cameras count as
//! what they show: they become smaller.
//!
//! Two models are rendered from one camera, with pixels half as wide as the camera's own. Only cameras of the model
//! that claims wider pixels tell: where pixels are so fine that neither model has detail, any two models agree.
//! Compared is the energy of the finest detail. Models of rendered Boruszyn trained on pictures of 240 px agree within
//! 6 %; the same ground at 160 px has 1.5 times less. That is the square root of the ratio of pixels on the ground, and
//! it is the same at 320 px.

use std::collections::BTreeMap;

use cosurf_engine::Renderer;
use cosurf_scene::Camera;
use glam::DVec2;
use serde::{Deserialize, Serialize};

use super::frames::groups;
use super::glimpse::median;
use super::similarity::solve;

/// Width and height of the part of a picture that is compared, px.
const WINDOW_PX: [u32; 2] = [320, 240];
/// Pixels are this many times finer than the camera's own.
const FINER: f64 = 2.0;
/// The pixels of the compared views are at least this many times as wide as those that the other model claims. With 0.9,
/// models of the same pictures are often compared in the views of only one of them, and their excess spreads from 0.67 to
/// 1.29 instead of 0.86 to 1.07.
const WIDTH_MIN: f64 = 0.8;
/// Both models show the same surface in a pixel if the logarithm of the ratio of their depths is at most this.
const DEPTH_MAX: f32 = 0.01;
/// Smallest number of squares of 2 × 2 pixels that are compared.
const SQUARES_MIN: usize = 1000;
/// A model may have this many times as many pixels on the ground as its detail suggests. Honest models stay below 1.3.
const FAIR_TIMES: f64 = 1.5;
/// Weight with which an excess is drawn to 0, beside one compared picture.
const SMALL_WEIGHT: f64 = 0.01;

/// Whether views with pixels of the first width on the ground tell how fine the detail of a model is that claims pixels of
/// the second width.
pub(super) fn are_wide_enough([of_views, claimed]: [Option<f64>; 2]) -> bool {
    matches!((of_views, claimed), (Some(of_views), Some(claimed)) if of_views >= WIDTH_MIN * claimed)
}

/// The middle of a camera's picture with fine pixels.
#[derive(Serialize, Deserialize)]
pub(super) struct Fine {
    /// `[height, width]`
    grey: Vec<f32>,
    /// `[height, width]` depth, world units; 0 where there is no surface.
    depth: Vec<f32>,
}

impl Fine {
    pub(super) fn of(renderer: &mut Renderer, camera: &Camera) -> Self {
        let rendering = renderer.render(&window(camera));
        let grey = rendering.rgb.chunks_exact(3).map(|rgb| (rgb[0] + rgb[1] + rgb[2]) / 3.0).collect();
        Self { grey, depth: rendering.depth }
    }

    /// Natural logarithm of the ratio of the energies of the finest detail, this model to the other one, where both
    /// show the same surface. `None` if that is too small a part of the picture.
    pub(super) fn log_ratio(&self, other: &Self) -> Option<f64> {
        let [width, height] = WINDOW_PX.map(|side| side as usize);
        let is_same = |i: usize| {
            let [a, b] = [self.depth[i], other.depth[i]];
            a > 0.0 && b > 0.0 && (a / b).ln().abs() <= DEPTH_MAX
        };
        let (mut squares, mut energies) = (0, [0.0; 2]);
        for y in (0..height).step_by(2) {
            for x in (0..width).step_by(2) {
                let at = y * width + x;
                let four = [at, at + 1, at + width, at + width + 1];
                if !four.into_iter().all(is_same) {
                    continue;
                }
                squares += 1;
                for (energy, of) in energies.iter_mut().zip([self, other]) {
                    let values = four.map(|i| f64::from(of.grey[i]));
                    let mean = values.iter().sum::<f64>() / 4.0;
                    *energy += values.iter().map(|value| (value - mean).powi(2)).sum::<f64>();
                }
            }
        }
        (squares >= SQUARES_MIN && energies.iter().all(|energy| *energy > 0.0))
            .then(|| (energies[0] / energies[1]).ln())
    }
}

/// The camera of the compared part of a picture.
fn window(camera: &Camera) -> Camera {
    let size = DVec2::from(camera.size_px.map(f64::from));
    let window = DVec2::from(WINDOW_PX.map(f64::from));
    // The middle of the picture stays in the middle.
    let center_px = FINER * (camera.center_px - 0.5 * size) + 0.5 * window;
    Camera { focal_px: FINER * camera.focal_px, center_px, size_px: WINDOW_PX, ..*camera }
}

/// How much finer the detail of a model is than that of another, lower index first: the sum of the logarithms of the
/// ratios of energies, and the number of compared pictures.
#[derive(Default)]
pub(super) struct Sharpness(BTreeMap<[usize; 2], (f64, f64)>);

impl Sharpness {
    /// Notes the logarithm of the ratio of energies, of the model `one` to the model `other`.
    pub(super) fn note(&mut self, one: usize, other: usize, log_ratio: f64) {
        let (pair, log_ratio) =
            if one < other { ([one, other], log_ratio) } else { ([other, one], -log_ratio) };
        let (sum, count) = self.0.entry(pair).or_default();
        *sum += log_ratio;
        *count += 1.0;
    }

    /// For each model, the factor on the sides of its pictures with which these are as large as its detail suggests; 1
    /// if the model claims no more than others do. `pixels` has the width of a pixel on the ground that each model
    /// claims, world units. Only models that are `sound` count.
    pub(super) fn sizes(&self, pixels: &[Option<f64>], sound: impl Fn(usize) -> bool) -> Vec<f64> {
        let count = pixels.len();
        // The excess of a model: logarithm of claimed to shown pixels on the same ground.
        let mut matrix = vec![vec![0.0; count]; count];
        let mut right = vec![vec![0.0]; count];
        let mut compared = Vec::new();
        (0..count).for_each(|i| matrix[i][i] = SMALL_WEIGHT);
        for (&[one, other], (sum, pictures)) in &self.0 {
            let [Some(a), Some(b)] = [pixels[one], pixels[other]] else { continue };
            if !sound(one) || !sound(other) {
                continue;
            }
            let excess = pictures * 2.0 * (b / a).ln() - 2.0 * sum;
            for (i, j, excess) in [(one, other, excess), (other, one, -excess)] {
                matrix[i][i] += pictures;
                matrix[i][j] -= pictures;
                right[i][0] += excess;
            }
            compared.push([one, other]);
        }
        let excess: Vec<f64> = solve(matrix, right).into_iter().map(|row| row[0]).collect();
        // Only models that were compared, directly or by way of others, tell what is usual.
        let groups = groups(compared.iter().copied(), count);
        let size = |i: usize| {
            let mut others: Vec<f64> =
                (0..count).filter(|j| groups[*j] == groups[i] && *j != i).map(|j| excess[j]).collect();
            let above = if others.is_empty() { 0.0 } else { excess[i] - median(&mut others) };
            if above > FAIR_TIMES.ln() { (-0.5 * above).exp() } else { 1.0 }
        };
        (0..count).map(size).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Models with these widths of a pixel, claimed and true, all of which were compared with each other.
    fn sizes(models: &[[f64; 2]]) -> Vec<f64> {
        let mut sharpness = Sharpness::default();
        for (i, [_, one]) in models.iter().enumerate() {
            for (j, [_, other]) in models.iter().enumerate().skip(i + 1) {
                (0..4).for_each(|_| sharpness.note(j, i, (one / other).ln()));
            }
        }
        sharpness.sizes(&models.iter().map(|[claimed, _]| Some(*claimed)).collect::<Vec<_>>(), |_| true)
    }

    #[test]
    fn honest_models_keep_their_sizes_whatever_these_are() {
        assert_eq!(sizes(&[[0.5, 0.5], [0.75, 0.75], [0.1, 0.1], [0.5, 0.55]]), [1.0; 4]);
        assert_eq!(sizes(&[[0.5, 0.5]]), [1.0]);
        assert!(sizes(&[]).is_empty());
    }

    #[test]
    fn a_model_that_claims_larger_pictures_gets_those_that_it_shows() {
        for times in [2.0, 8.0] {
            let found = sizes(&[[0.5, 0.5], [0.52, 0.5], [0.75 / times, 0.75], [0.5, 0.5], [0.5, 0.5]]);
            assert!((found[2] * times - 1.0).abs() < 0.05, "{found:?}");
            assert!([0, 1, 3, 4].iter().all(|i| found[*i] == 1.0), "{found:?}");
            let [one, other] = sizes(&[[0.5, 0.5], [0.75 / times, 0.75]])[..] else { unreachable!() };
            assert!(one == 1.0 && (other * times - 1.0).abs() < 0.05, "{one} {other}");
        }
    }

    #[test]
    fn only_views_of_wide_pixels_tell_how_fine_the_detail_is() {
        let are_wide_enough = |of_views, claimed| are_wide_enough([of_views, claimed]);
        assert!(are_wide_enough(Some(0.5), Some(0.5)) && are_wide_enough(Some(0.5), Some(0.1)));
        assert!(!are_wide_enough(Some(0.1), Some(0.5)));
        assert!(!are_wide_enough(None, Some(0.5)) && !are_wide_enough(Some(0.5), None));
    }

    #[test]
    fn models_that_are_not_sound_do_not_count() {
        let mut sharpness = Sharpness::default();
        sharpness.note(0, 1, -3.0);
        assert_eq!(sharpness.sizes(&[Some(0.5); 2], |i| i == 0), [1.0; 2]);
        assert_eq!(sharpness.sizes(&[Some(0.5), None], |_| true), [1.0; 2]);
        assert!(sharpness.sizes(&[Some(0.5); 2], |_| true)[0] < 0.3);
    }

    #[test]
    fn the_window_is_the_middle_of_the_picture_also_of_claims_beyond_reason() {
        let camera = crate::testing::above(3.0);
        let fine = window(&camera);
        let middle = |camera: &Camera| {
            let middle_px = 0.5 * DVec2::from(camera.size_px.map(f64::from));
            camera.unproject(middle_px, 5.0)
        };
        assert!(middle(&camera).distance(middle(&fine)) < 1e-9);
        assert_eq!(fine.focal_px, 2.0 * camera.focal_px);
        let huge = window(&Camera { size_px: [u32::MAX; 2], ..camera });
        assert!(huge.size_px == WINDOW_PX && huge.center_px.is_finite());
    }
}
