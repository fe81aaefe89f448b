//! Heights for cells that have none, from those around: as a membrane that is held by the known heights.
//!
//! What it knows nothing about: what heights mean.

/// How often each unknown cell becomes the mean of its neighbours at each level of the pyramid. The level above has the
/// long waves already, so few rounds smooth the rest.
const ROUNDS: usize = 8;

/// Replaces each NaN, row by row. Nothing happens if all are NaN.
pub(super) fn fill(heights: &mut [f32], size: [usize; 2]) {
    let unknown: Vec<usize> = (0..heights.len()).filter(|cell| heights[*cell].is_nan()).collect();
    if unknown.is_empty() || unknown.len() == heights.len() {
        return;
    }
    let [width, height] = size;
    let half = size.map(|side| side.div_ceil(2));
    let mut coarse = halved(heights, size);
    fill(&mut coarse, half);
    for cell in &unknown {
        let [x, y] = [cell % width, cell / width];
        // The centre of a cell is a quarter of a coarse cell from that of the coarse cell it lies in.
        let beside = |at: usize, side: usize| {
            let next = if at % 2 == 1 { at / 2 + 1 } else { (at / 2).saturating_sub(1) };
            [at / 2, next.min(side - 1)]
        };
        let ([x, beside_x], [y, beside_y]) = (beside(x, half[0]), beside(y, half[1]));
        let row = |y: usize| 0.75 * coarse[y * half[0] + x] + 0.25 * coarse[y * half[0] + beside_x];
        heights[*cell] = 0.75 * row(y) + 0.25 * row(beside_y);
    }
    for _ in 0..ROUNDS {
        for cell in &unknown {
            let [x, y] = [cell % width, cell / width];
            let around = [
                (x > 0).then(|| cell - 1),
                (x + 1 < width).then(|| cell + 1),
                (y > 0).then(|| cell - width),
                (y + 1 < height).then(|| cell + width),
            ];
            let (sum, count) = around
                .into_iter()
                .flatten()
                .fold((0.0, 0.0), |(sum, count), beside| (sum + heights[beside], count + 1.0));
            heights[*cell] = sum / count;
        }
    }
}

/// The means of squares of two by two cells, without those that are missing.
fn halved(heights: &[f32], size: [usize; 2]) -> Vec<f32> {
    let [width, height] = size.map(|side| side.div_ceil(2));
    let mean = |x: usize, y: usize| {
        let (mut sum, mut count) = (0.0, 0.0);
        for (x, y) in [(2 * x, 2 * y), (2 * x + 1, 2 * y), (2 * x, 2 * y + 1), (2 * x + 1, 2 * y + 1)] {
            if x < size[0] && y < size[1] && !heights[y * size[0] + x].is_nan() {
                sum += heights[y * size[0] + x];
                count += 1.0;
            }
        }
        sum / count // of no height, NaN
    };
    (0..width * height).map(|i| mean(i % width, i / width)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hole_in_a_slope_gets_the_heights_of_the_slope() {
        let slope = |i: usize| 70.0 + 0.1 * (i % 61) as f32 - 0.05 * (i / 61) as f32;
        let hole = |i: usize| (20..40).contains(&(i % 61)) && (10..40).contains(&(i / 61));
        let mut heights: Vec<f32> = (0..61 * 50).map(|i| if hole(i) { f32::NAN } else { slope(i) }).collect();
        fill(&mut heights, [61, 50]);
        for i in 0..heights.len() {
            let error = (heights[i] - slope(i)).abs();
            assert!(error < if hole(i) { 0.25 } else { 1e-6 }, "cell {i}: {error} m");
        }
    }

    #[test]
    fn nothing_known_stays_nothing() {
        let mut heights = vec![f32::NAN; 6];
        fill(&mut heights, [3, 2]);
        assert!(heights.iter().all(|height| height.is_nan()));
    }
}
