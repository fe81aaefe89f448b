//! The progressive morphological filter: Zhang et al., "A progressive morphological filter for removing nonground
//! measurements from airborne LIDAR data", IEEE Transactions on Geoscience and Remote Sensing 41(4), 2003.
//!
//! An opening with a window (the highest of the lowest heights) removes what is narrower than the window. What it lowers
//! by more than terrain with a slope would be lowered is an object. Windows grow from one to the next, and each opening is
//! compared with the one before: the window that is wider than a house lowers it all at once, but a hill loses a little to
//! each. So windows grow by steps and not, as the paper also allows, by factors.
//!
//! What it knows nothing about: pixels.

use rayon::prelude::*;

/// Slope of the terrain, metres up per metre, as in the paper. A ridge keeps its top up to twice this slope on both sides.
pub(super) const SLOPE: f64 = 0.15;
/// Height of the lowest objects, metres.
pub(super) const STEP_LEAST_M: f64 = 0.3;
/// Height from which everything is an object however large the window, metres: a low shed. A hill loses less to one window.
const STEP_MOST_M: f64 = 1.5;
/// By how many cells half of a window grows; smaller windows double.
const GROWTH: usize = 4;
/// Half of the width of the widest buildings, metres.
pub(super) const HALF_WIDTH_MAX_M: f64 = 25.0;

/// For each cell, row by row: whether it is ground. Cells without a height (NaN) are not.
pub(super) fn is_ground(heights: &[f32], size: [usize; 2], cell_m: f64) -> Vec<bool> {
    let mut is_ground: Vec<bool> = heights.iter().map(|height| !height.is_nan()).collect();
    let mut surface = heights.to_vec();
    let (mut half, mut width_before) = (1, 1);
    loop {
        let lowest = extreme(&surface, size, half, f32::min);
        let opened = extreme(&lowest, size, half, f32::max);
        let width = 2 * half + 1;
        let rise_m = SLOPE * (width - width_before) as f64 * cell_m;
        // Equation 5 of the paper.
        let step_m = if width <= 3 { STEP_LEAST_M } else { (rise_m + STEP_LEAST_M).min(STEP_MOST_M) };
        for (cell, is_ground) in is_ground.iter_mut().enumerate() {
            *is_ground &= f64::from(surface[cell] - opened[cell]) <= step_m;
        }
        surface = opened;
        if half as f64 * cell_m >= HALF_WIDTH_MAX_M {
            return is_ground;
        }
        (half, width_before) = ((2 * half).min(half + GROWTH), width);
    }
}

/// The lowest or highest height in the square of `2 · half + 1` cells around each cell, without those that are missing.
fn extreme(heights: &[f32], size: [usize; 2], half: usize, of: fn(f32, f32) -> f32) -> Vec<f32> {
    // `f32::min` and `f32::max` return the other number if one is NaN.
    let along = along_rows(heights, size[0], half, of);
    let turned = along_rows(&transposed(&along, size[0]), size[1], half, of);
    transposed(&turned, size[1])
}

/// The same along rows only. Van Herk 1992: in blocks as long as the window, the extremes from the block's beginning and
/// those to its end give that of any window, so the time does not depend on the window.
fn along_rows(heights: &[f32], width: usize, half: usize, of: fn(f32, f32) -> f32) -> Vec<f32> {
    let block = 2 * half + 1;
    let mut out = vec![f32::NAN; heights.len()];
    out.par_chunks_mut(width).zip(heights.par_chunks(width)).for_each(|(out, row)| {
        let [mut from_start, mut to_end] = [row.to_vec(), row.to_vec()];
        for i in (0..width).filter(|i| i % block != 0) {
            from_start[i] = of(from_start[i - 1], row[i]);
        }
        for i in (0..width - 1).rev().filter(|i| (i + 1) % block != 0) {
            to_end[i] = of(to_end[i + 1], row[i]);
        }
        for (i, out) in out.iter_mut().enumerate() {
            let [first, last] = [i.saturating_sub(half), (i + half).min(width - 1)];
            *out = match first / block == last / block {
                // A window that the edge cuts may lie within one block.
                true => row[first..=last].iter().copied().fold(f32::NAN, of),
                false => of(to_end[first], from_start[last]),
            };
        }
    });
    out
}

fn transposed(heights: &[f32], width: usize) -> Vec<f32> {
    let height = heights.len() / width;
    (0..heights.len()).map(|i| heights[i % height * width + i / height]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn extremes_are_those_of_the_window() {
        let size = [13, 9];
        let heights: Vec<f32> =
            (0..117).map(|i| if i % 11 == 0 { f32::NAN } else { (i * 37 % 50) as f32 }).collect();
        for half in [1, 2, 5, 20] {
            let found = extreme(&heights, size, half, f32::max);
            for i in 0..117 {
                let near = |a: usize, b: usize| a.abs_diff(b) <= half;
                let around = (0..117).filter(|j| near(i % 13, j % 13) && near(i / 13, j / 13));
                let wanted = around.map(|j| heights[j]).fold(f32::NAN, f32::max);
                assert_eq!(found[i], wanted, "cell {i}, half {half}");
            }
        }
    }

    #[test]
    fn houses_are_removed_and_hills_stay() {
        let height = |i: usize| {
            let [x, y] = [i % 100, i / 100].map(|of| of as f32);
            let hill = 3.0 * (x * 0.05).sin();
            if (40.0..60.0).contains(&x) && (30.0..70.0).contains(&y) { hill + 5.0 } else { hill }
        };
        let heights: Vec<f32> = (0..10_000).map(height).collect();
        let found = is_ground(&heights, [100, 100], 1.0);
        let wrong = (0..10_000).filter(|i| {
            let [x, y] = [i % 100, i / 100];
            found[*i] == ((40..60).contains(&x) && (30..70).contains(&y))
        });
        assert_eq!(wrong.count(), 0);
    }
}
