//! Finds distinctive places of a model that can be recognised in another model, whatever frame either of them is in.
//!
//! A model is rendered from some of its own cameras. Corners of these pictures are described by the directions of the
//! grey-value gradients around them, as in SIFT (Lowe, "Distinctive image features from scale-invariant keypoints").
//! The descriptor turns with the picture, and corners are found in several sizes of the picture. So the same place has
//! almost the same descriptor in pictures that are turned, or taken from another height.

use std::f32::consts::TAU;
use std::f64::consts::SQRT_2;

use cosurf_engine::Renderer;
use cosurf_scene::Camera;
use glam::DVec3;
use rayon::prelude::*;

use super::matching::{Sight, middle};

/// Largest number of views in which places are looked for.
const VIEWS: usize = 12;
/// Long side of the largest pictures, px. Each further size is smaller by [`SIZE_STEP`].
const SIZE_PX: u32 = 320;
/// Ratio of the long sides of one size to the next.
const SIZE_STEP: f64 = SQRT_2;
/// Number of sizes.
const SIZES: u32 = 4;
/// Side of a square of the picture that gives at most one corner, px.
const CELL_PX: usize = 10;
/// Least strength of a corner; see [`Sight::cornerness`].
const STRENGTH_MIN: f32 = 2e-5;
/// Distance from a corner to the sides of the square that its descriptor covers, px.
const REACH_PX: usize = 10;
/// Cells of the descriptor along each side of the square.
const CELLS: usize = 4;
/// Directions of gradients that the descriptor distinguishes.
const DIRECTIONS: usize = 8;
/// Numbers of a descriptor.
const LENGTH: usize = CELLS * CELLS * DIRECTIONS;
/// Directions of gradients that the search for the main direction distinguishes.
const TURNS: usize = 36;
/// Limit on a number of a descriptor before it is normalised again (Lowe): one strong edge must not decide.
const NUMBER_MAX: f32 = 0.2;

/// A place that can be recognised.
#[derive(Clone, Debug)]
pub(super) struct Feature {
    /// Position in the model's frame.
    pub(super) at: DVec3,
    /// Width at the place of a pixel of the picture in which the place was found, units of the model.
    pub(super) pixel_m: f64,
    descriptor: [f32; LENGTH],
}

impl Feature {
    /// Similarity of two descriptors: the cosine of the angle between them.
    pub(super) fn likeness(&self, other: &Self) -> f32 {
        self.descriptor.iter().zip(&other.descriptor).map(|(a, b)| a * b).sum()
    }

    /// The features that some of `cameras` see.
    pub(super) fn find(renderer: &mut Renderer, cameras: &[Camera]) -> Vec<Self> {
        let views = VIEWS.min(cameras.len());
        let mut found = Vec::new();
        for i in 0..views {
            let camera = cameras[i * cameras.len() / views];
            for size in 0..SIZES {
                let long_side = f64::from(SIZE_PX) / SIZE_STEP.powi(size as i32);
                let sight = Sight::of(renderer, camera.fitted(long_side as u32));
                found.extend(in_picture(&sight));
            }
        }
        found
    }
}

fn in_picture(sight: &Sight) -> Vec<Feature> {
    let [width, height] = sight.size();
    let margin = 2 * REACH_PX;
    let starts = |length: usize| (margin..length.saturating_sub(margin)).step_by(CELL_PX);
    let cells: Vec<[usize; 2]> = starts(height).flat_map(|y| starts(width).map(move |x| [x, y])).collect();
    let feature = |&[left, top]: &[usize; 2]| {
        let mut best = (STRENGTH_MIN, None);
        for y in top..(top + CELL_PX).min(height - margin) {
            for x in left..(left + CELL_PX).min(width - margin) {
                let strength = sight.cornerness(x, y);
                if strength > best.0 {
                    best = (strength, Some([x, y]));
                }
            }
        }
        let [x, y] = best.1.filter(|[x, y]| sight.is_solid(*x, *y))?;
        let descriptor = describe(sight, x, y)?;
        Some(Feature { at: sight.point(x, y, middle(x, y)), pixel_m: sight.pixel_m(x, y), descriptor })
    };
    cells.par_iter().filter_map(feature).collect()
}

/// The descriptor of the place around a pixel, a unit vector. `None` if the picture is uniform there.
fn describe(sight: &Sight, x: usize, y: usize) -> Option<[f32; LENGTH]> {
    let main = main_direction(sight, x, y);
    let (sin, cos) = libm::sincosf(main);
    let reach = REACH_PX as isize;
    let mut numbers = [0.0f32; LENGTH];
    for dy in -reach..=reach {
        for dx in -reach..=reach {
            // The position in the picture of a point of the turned square.
            let (u, v) = (dx as f32, dy as f32);
            let [px, py] = [cos * u - sin * v, sin * u + cos * v].map(|offset| offset.round() as isize);
            let (strength, direction) = gradient(sight, x.wrapping_add_signed(px), y.wrapping_add_signed(py));
            let weight = strength * libm::expf(-(u * u + v * v) / (2.0 * (REACH_PX * REACH_PX) as f32 * 0.5));
            let cell = |offset: f32| {
                (offset + REACH_PX as f32 + 0.5) / (2 * REACH_PX + 1) as f32 * CELLS as f32 - 0.5
            };
            let turn = (direction - main).rem_euclid(TAU) / TAU * DIRECTIONS as f32;
            spread(&mut numbers, [cell(u), cell(v), turn], weight);
        }
    }
    normalise(&mut numbers)?;
    numbers.iter_mut().for_each(|number| *number = number.min(NUMBER_MAX));
    normalise(&mut numbers)?;
    Some(numbers)
}

/// Adds a gradient to the eight numbers of the descriptor next to it, by trilinear weights.
fn spread(numbers: &mut [f32; LENGTH], [u, v, turn]: [f32; 3], weight: f32) {
    let base = [u.floor(), v.floor(), turn.floor()];
    for corner in 0..8 {
        let step = [corner & 1, corner >> 1 & 1, corner >> 2];
        let mut share = weight;
        for ((value, base), step) in [u, v, turn].into_iter().zip(base).zip(step) {
            let beyond = value - base;
            share *= if step == 1 { beyond } else { 1.0 - beyond };
        }
        let (column, row) = (base[0] as isize + step[0] as isize, base[1] as isize + step[1] as isize);
        let inside = 0..CELLS as isize;
        if inside.contains(&column) && inside.contains(&row) {
            let direction = (base[2] as usize + step[2]) % DIRECTIONS;
            numbers[(row as usize * CELLS + column as usize) * DIRECTIONS + direction] += share;
        }
    }
}

/// Scales the numbers to a unit vector. `None` if they are all zero.
fn normalise(numbers: &mut [f32; LENGTH]) -> Option<()> {
    let length = numbers.iter().map(|number| number * number).sum::<f32>().sqrt();
    (length > 1e-6).then(|| numbers.iter_mut().for_each(|number| *number /= length))
}

/// The direction that most gradients around a pixel have, radians.
fn main_direction(sight: &Sight, x: usize, y: usize) -> f32 {
    let reach = REACH_PX as isize;
    let mut sums = [0.0f32; TURNS];
    for dy in -reach..=reach {
        for dx in -reach..=reach {
            let distance2 = (dx * dx + dy * dy) as f32;
            if distance2 > (REACH_PX * REACH_PX) as f32 {
                continue;
            }
            let (strength, direction) = gradient(sight, x.wrapping_add_signed(dx), y.wrapping_add_signed(dy));
            let weight = strength * libm::expf(-distance2 / (2.0 * (REACH_PX * REACH_PX) as f32 * 0.25));
            let turn = direction.rem_euclid(TAU) / TAU * TURNS as f32;
            sums[turn as usize % TURNS] += weight;
        }
    }
    let smooth = |i: usize| sums[(i + TURNS - 1) % TURNS] + 2.0 * sums[i] + sums[(i + 1) % TURNS];
    let best = (0..TURNS).fold(0, |best, i| if smooth(i) > smooth(best) { i } else { best });
    let [before, here, after] = [TURNS - 1, 0, 1].map(|step| smooth((best + step) % TURNS));
    let bend = before - 2.0 * here + after;
    let beyond = if bend < 0.0 { (0.5 * (before - after) / bend).clamp(-0.5, 0.5) } else { 0.0 };
    (best as f32 + 0.5 + beyond) * TAU / TURNS as f32
}

/// Strength and direction (radians) of the gradient of the grey values at a pixel.
fn gradient(sight: &Sight, x: usize, y: usize) -> (f32, f32) {
    let [dx, dy] = sight.gradient(x, y);
    (libm::hypotf(dx, dy), libm::atan2f(dy, dx))
}
