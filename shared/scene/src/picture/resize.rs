//! Exact area average: each new pixel is the mean of the old picture over the area that the new pixel
//! covers. An old pixel that is partly covered counts in proportion to its covered part. Computed in
//! integers, so every machine gets the same bytes.

use super::pixels::Picture;

/// Resamples `picture` to `size_px`.
pub(super) fn area_average(picture: &Picture, size_px: [u32; 2]) -> Picture {
    let columns = spans(picture.size_px[0], size_px[0]);
    let rows = spans(picture.size_px[1], size_px[1]);
    let old_row = 3 * picture.size_px[0] as usize;
    let area = u64::from(picture.size_px[0]) * u64::from(picture.size_px[1]);
    // The old row `shrunk_y`, resampled along x. The result is kept, because two neighbouring new rows
    // may both cover the old row at their border.
    let mut shrunk = vec![0_u32; 3 * columns.len()];
    let mut shrunk_y = None;
    let mut sums = vec![0_u64; shrunk.len()];
    let mut rgb = Vec::with_capacity(shrunk.len() * rows.len());
    for row in &rows {
        sums.fill(0);
        for (y, &weight) in (row.first..).zip(&row.weights) {
            if shrunk_y.replace(y) != Some(y) {
                shrink_row(&picture.rgb[y * old_row..(y + 1) * old_row], &columns, &mut shrunk);
            }
            for (sum, &value) in sums.iter_mut().zip(&shrunk) {
                *sum += u64::from(weight) * u64::from(value);
            }
        }
        rgb.extend(sums.iter().map(|sum| ((sum + area / 2) / area) as u8));
    }
    Picture::new(size_px, rgb)
}

/// Upper bound on the bytes that [`area_average`] allocates besides the old and the new picture.
pub(super) fn scratch_bytes(size_px: [u32; 2]) -> u64 {
    // Each new column takes 36 bytes: three sums of 64 bits and three of 32 bits. Two `Span`s, one of a column and one
    // of a row, take 64 bytes; there are at most as many of each as the longer new side has pixels. The last term, 1
    // MiB, is for the weights of all spans. It is enough for up to 65,535 old pixels per side.
    36 * u64::from(size_px[0]) + 64 * u64::from(size_px[0].max(size_px[1])) + (1 << 20)
}

/// The old pixels that a new pixel covers along one axis.
struct Span {
    /// Index of the first old pixel that is covered.
    first: usize,
    /// For `first` and for each old pixel after it: the covered part of the pixel, in units of `1 / new`,
    /// where `new` is the number of new pixels along the axis. These weights sum to the number of old pixels
    /// along the axis.
    weights: Vec<u32>,
}

fn spans(old: u32, new: u32) -> Vec<Span> {
    let (old, new) = (u64::from(old), u64::from(new));
    let span = |i: u64| {
        let (begin, end) = (i * old, (i + 1) * old);
        let touched = begin / new..end.div_ceil(new);
        let covered = |pixel: u64| ((pixel + 1) * new).min(end) - (pixel * new).max(begin);
        Span { first: touched.start as usize, weights: touched.map(|pixel| covered(pixel) as u32).collect() }
    };
    (0..new).map(span).collect()
}

fn shrink_row(old: &[u8], columns: &[Span], new: &mut [u32]) {
    for (new, column) in new.chunks_exact_mut(3).zip(columns) {
        let mut sums = [0_u32; 3];
        for (pixel, &weight) in old[3 * column.first..].chunks_exact(3).zip(&column.weights) {
            // No overflow for pictures up to 2²⁴ pixels wide: the weights sum to the old width, and
            // 255·2²⁴ < 2³².
            sums.iter_mut().zip(pixel).for_each(|(sum, &value)| *sum += weight * u32::from(value));
        }
        new.copy_from_slice(&sums);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn made_up(size_px: [u32; 2]) -> Picture {
        let n = 3 * size_px[0] * size_px[1];
        Picture::new(size_px, (0..n).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect())
    }

    /// The mean of the old picture over the area of the new pixel (`x`, `y`), straight from the
    /// definition and in floating point.
    fn mean_over(picture: &Picture, size_px: [u32; 2], x: u32, y: u32, channel: u32) -> f64 {
        let overlap = |i: u32, axis: usize, new: u32| {
            let scale = f64::from(picture.size_px[axis]) / f64::from(size_px[axis]);
            let (begin, end) = (f64::from(new) * scale, f64::from(new + 1) * scale);
            (end.min(f64::from(i + 1)) - begin.max(f64::from(i))).max(0.0) / scale
        };
        let mut mean = 0.0;
        for v in 0..picture.size_px[1] {
            for u in 0..picture.size_px[0] {
                let at = 3 * (v * picture.size_px[0] + u) + channel;
                mean += overlap(u, 0, x) * overlap(v, 1, y) * f64::from(picture.rgb[at as usize]);
            }
        }
        mean
    }

    #[test]
    fn every_pixel_is_the_mean_of_its_area() {
        for (old, new) in
            [([13, 9], [5, 4]), ([12, 8], [6, 2]), ([7, 5], [7, 1]), ([3, 2], [7, 5]), ([4, 4], [1, 1])]
        {
            let picture = made_up(old);
            let small = area_average(&picture, new);
            assert_eq!(small.size_px, new);
            for (i, &value) in small.rgb.iter().enumerate() {
                let (x, y) = (i as u32 / 3 % new[0], i as u32 / 3 / new[0]);
                let mean = mean_over(&picture, new, x, y, i as u32 % 3);
                assert!((f64::from(value) - mean).abs() <= 0.5 + 1e-9, "{old:?} to {new:?} at {x},{y}");
            }
        }
    }

    #[test]
    fn the_same_size_is_the_same_picture() {
        let picture = made_up([11, 6]);
        assert_eq!(area_average(&picture, [11, 6]), picture);
    }

    #[test]
    fn white_stays_white_at_any_size() {
        let white = Picture::new([640, 3], vec![255; 640 * 9]);
        for side in [1, 7, 639] {
            assert!(area_average(&white, [side, 2]).rgb.iter().all(|&value| value == 255));
        }
    }
}
