//! Measures how fine the detail is that each model shows, beside the others. Whoever claims larger pictures or nearer
//! cameras than it had must show finer detail where other models show the same ground. Otherwise its cameras count as
//! what they show: they become smaller.
//!
//! Two models are rendered from one camera, with pixels half as wide as the camera's own. Only cameras with pixels as wide
//! as those that the model claims there tell: where pixels are so fine that neither model has detail, any two models
//! agree. Compared is the energy of the finest detail. Models of rendered Boruszyn trained on pictures of 240 px agree within
//! 6 %; the same ground at 160 px has 1.5 times less. That is the square root of the ratio of pixels on the ground, and
//! it is the same at 320 px.

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
/// The pixels of the compared views are at least this many times as wide as those that the model claims there. With 0.9,
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

/// Whether a view with the first number of pixels on a square of one world unit tells how fine the detail of a model is
/// that claims the second number there.
pub(super) fn are_wide_enough([of_view, claimed]: [f64; 2]) -> bool {
    of_view * WIDTH_MIN * WIDTH_MIN <= claimed
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
            a > 0.0 && b > 0.0 && libm::logf(a / b).abs() <= DEPTH_MAX
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
            .then(|| libm::log(energies[0] / energies[1]))
    }
}

/// The camera of the compared part of a picture.
pub(super) fn window(camera: &Camera) -> Camera {
    let size = DVec2::from(camera.size_px.map(f64::from));
    let window = DVec2::from(WINDOW_PX.map(f64::from));
    // The middle of the picture stays in the middle.
    let center_px = FINER * (camera.center_px - 0.5 * size) + 0.5 * window;
    Camera { focal_px: FINER * camera.focal_px, center_px, size_px: WINDOW_PX, ..*camera }
}

/// What a picture tells of two models.
#[derive(Clone, Copy, Debug)]
pub(super) struct Told {
    /// Logarithm of the ratio of the energies of the finest detail, of the one model to the other.
    pub(super) log_ratio: f64,
    /// Number of pixels on a square of one world unit that the one model and the other one claim there.
    pub(super) claimed: [f64; 2],
}

/// What is left of the claims of a model.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Granted {
    /// Factor on the sides of the model's pictures with which these are as large as its detail suggests; 1 if the model
    /// claims no more than others do.
    pub(super) size: f64,
    /// Most pixels on a square of one world unit that were checked, and some more; all claims beyond count as so many.
    /// The model's pictures have the right size already.
    pub(super) pixels_max: f64,
}

/// What all pictures tell.
#[derive(Default)]
pub(super) struct Sharpness(Vec<Compared>);

/// Two models in a picture.
struct Compared {
    models: [usize; 2],
    /// Logarithm of claimed to shown pixels, the first model to the second.
    excess: f64,
    /// Number of pixels on a square of one world unit that each claims.
    claimed: [f64; 2],
}

impl Sharpness {
    /// Notes what a picture tells of the model `one` beside the model `other`.
    pub(super) fn note(&mut self, one: usize, other: usize, Told { log_ratio, claimed }: Told) {
        let excess = libm::log(claimed[0] / claimed[1]) - 2.0 * log_ratio;
        self.0.push(Compared { models: [one, other], excess, claimed });
    }

    /// What is granted to each of `count` models. Only models that are `sound` count.
    pub(super) fn granted(&self, count: usize, sound: impl Fn(usize) -> bool) -> Vec<Granted> {
        // The excess of a model: logarithm of claimed to shown pixels on the same ground.
        let mut matrix = vec![vec![0.0; count]; count];
        let mut right = vec![vec![0.0]; count];
        (0..count).for_each(|i| matrix[i][i] = SMALL_WEIGHT);
        let compared = || self.0.iter().filter(|its| its.models.into_iter().all(&sound));
        for Compared { models: [one, other], excess, .. } in compared() {
            for (i, j, excess) in [(*one, *other, *excess), (*other, *one, -excess)] {
                matrix[i][i] += 1.0;
                matrix[i][j] -= 1.0;
                right[i][0] += excess;
            }
        }
        let excess: Vec<f64> = solve(matrix, right).into_iter().map(|row| row[0]).collect();
        // Only models that were compared, directly or by way of others, tell what is usual.
        let groups = groups(compared().map(|its| its.models), count);
        let granted = |i: usize| {
            let mut others: Vec<f64> =
                (0..count).filter(|j| groups[*j] == groups[i] && *j != i).map(|j| excess[j]).collect();
            let usual = if others.is_empty() { excess[i] } else { median(&mut others) };
            let above = excess[i] - usual;
            let size = if above > libm::log(FAIR_TIMES) { libm::exp(-0.5 * above) } else { 1.0 };
            // In each picture: what the model claims there, as far as the picture shows it.
            let checked = compared().filter_map(|its| {
                let side = its.models.iter().position(|model| *model == i)?;
                let other = excess[its.models[1 - side]];
                let above = if side == 0 { its.excess + other } else { other - its.excess } - usual;
                Some(its.claimed[side] * (size * size).min(libm::exp(-above)))
            });
            let pixels_max = checked.fold(0.0, f64::max) * FAIR_TIMES;
            Granted { size, pixels_max: if pixels_max > 0.0 { pixels_max } else { f64::INFINITY } }
        };
        (0..count).map(granted).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Models with these widths of a pixel, claimed and true, all of which were compared with each other.
    fn granted(models: &[[f64; 2]]) -> Vec<Granted> {
        let mut sharpness = Sharpness::default();
        for (i, one) in models.iter().enumerate() {
            for (j, other) in models.iter().enumerate().skip(i + 1) {
                (0..4).for_each(|_| sharpness.note(j, i, told(*other, *one)));
            }
        }
        sharpness.granted(models.len(), |_| true)
    }

    /// What a picture tells of two models with these widths of a pixel, claimed and true.
    fn told(one: [f64; 2], other: [f64; 2]) -> Told {
        let claimed = [one, other].map(|[claimed, _]| claimed.powi(-2));
        Told { log_ratio: (other[1] / one[1]).ln(), claimed }
    }

    fn sizes(models: &[[f64; 2]]) -> Vec<f64> {
        granted(models).into_iter().map(|its| its.size).collect()
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
    fn only_what_was_checked_counts() {
        let honest = |its: &Granted, pixel: f64| {
            let times = its.pixels_max * pixel * pixel;
            assert!((1.0..2.0).contains(&times), "{its:?}, {times} times");
        };
        let all = granted(&[[0.5, 0.5], [0.75, 0.75], [0.1, 0.1], [0.5, 0.5]]);
        [0.5, 0.75, 0.1, 0.5].into_iter().enumerate().for_each(|(i, pixel)| honest(&all[i], pixel));
        honest(&granted(&[[0.5, 0.5], [0.5, 0.5], [0.1, 0.5]])[2], 0.5);
        assert_eq!(granted(&[[0.5, 0.5]])[0].pixels_max, f64::INFINITY, "compared with no other");
        // A model whose claims hold in most pictures, beside two others: once it claims more than it shows, and once it
        // shows what it claims.
        for (shown, pixel) in [(0.5, 0.5), (0.1, 0.1)] {
            let mut sharpness = Sharpness::default();
            for other in [0, 1] {
                (0..4).for_each(|_| sharpness.note(2, other, told([0.5, 0.5], [0.5, 0.5])));
                sharpness.note(2, other, told([0.1, shown], [0.5, 0.5]));
            }
            (0..4).for_each(|_| sharpness.note(1, 0, told([0.5, 0.5], [0.5, 0.5])));
            let its = sharpness.granted(3, |_| true)[2];
            let times = its.pixels_max * pixel * pixel;
            assert!((1.0..3.0).contains(&times), "{its:?}, {times} times");
        }
    }

    #[test]
    fn only_views_of_wide_pixels_tell_how_fine_the_detail_is() {
        assert!(are_wide_enough([4.0, 4.0]) && are_wide_enough([4.0, 100.0]));
        assert!(!are_wide_enough([100.0, 4.0]));
    }

    #[test]
    fn models_that_are_not_sound_do_not_count() {
        let mut sharpness = Sharpness::default();
        sharpness.note(0, 1, Told { log_ratio: -3.0, claimed: [4.0; 2] });
        let none = Granted { size: 1.0, pixels_max: f64::INFINITY };
        assert_eq!(sharpness.granted(2, |i| i == 0), [none; 2]);
        assert!(sharpness.granted(2, |_| true)[0].size < 0.3);
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
