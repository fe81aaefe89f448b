//! Exact area average: each new pixel is the mean of the old picture over the area that the new pixel
//! covers. An old pixel that is partly covered counts in proportion to its covered part. Computed in
//! integers, so every machine gets the same bytes.

use super::pixels::Picture;

/// Resamples `picture` to `size_px`.
pub(super) fn area_average(picture: &Picture, size_px: [u32; 2]) -> Picture {
    area_average_of(picture, picture.size_px, 1, size_px)
}

/// As [`area_average`], of a picture of size `old_px` that was read at one part in `divisor` of that size.
pub(super) fn area_average_of(
    picture: &Picture,
    old_px: [u32; 2],
    divisor: u32,
    size_px: [u32; 2],
) -> Picture {
    let mut average = AreaAverage::new(old_px, divisor, size_px);
    picture.rgb.chunks_exact(3 * picture.size_px[0] as usize).for_each(|row| average.add_row(row));
    average.finish()
}

/// A picture that is resampled row by row.
pub(super) struct AreaAverage {
    size_px: [u32; 2],
    columns: Vec<Span>,
    rows: Vec<Span>,
    /// Number of old pixels.
    area: u64,
    /// Number of old rows so far.
    old_rows: usize,
    /// The newest old row, resampled along x.
    shrunk: Vec<u32>,
    /// Sums of the new row that is not complete yet.
    sums: Vec<u64>,
    /// Number of complete new rows.
    done: usize,
    rgb: Vec<u8>,
}

impl AreaAverage {
    /// From a picture of size `old_px`, whose pixels are joined in squares of `divisor` × `divisor`, to one of size `size_px`.
    pub(super) fn new(old_px: [u32; 2], divisor: u32, size_px: [u32; 2]) -> Self {
        let [columns, rows] = [0, 1].map(|axis| spans(old_px[axis], divisor, size_px[axis]));
        Self {
            size_px,
            area: u64::from(old_px[0]) * u64::from(old_px[1]),
            old_rows: 0,
            shrunk: vec![0; 3 * columns.len()],
            sums: vec![0; 3 * columns.len()],
            done: 0,
            rgb: Vec::with_capacity(3 * columns.len() * rows.len()),
            columns,
            rows,
        }
    }

    /// Adds the next old row, `[width, rgb]`; rows after the last one are ignored.
    pub(super) fn add_row(&mut self, old: &[u8]) {
        let y = self.old_rows;
        self.old_rows += 1;
        if self.done < self.rows.len() {
            shrink_row(old, &self.columns, &mut self.shrunk);
        }
        // Two neighbouring new rows may both cover the old row at their border; of a picture that grows, many do.
        while let Some(row) = self.rows.get(self.done) {
            let Some(&weight) = y.checked_sub(row.first).and_then(|i| row.weights.get(i)) else { return };
            for (sum, &value) in self.sums.iter_mut().zip(&self.shrunk) {
                *sum += u64::from(weight) * u64::from(value);
            }
            if y + 1 < row.first + row.weights.len() {
                return;
            }
            let area = self.area;
            self.rgb.extend(self.sums.iter().map(|sum| ((sum + area / 2) / area) as u8));
            self.sums.fill(0);
            self.done += 1;
        }
    }

    /// The new picture. Rows that were not added are black.
    pub(super) fn finish(mut self) -> Picture {
        self.rgb.resize(3 * self.columns.len() * self.rows.len(), 0);
        Picture::new(self.size_px, self.rgb)
    }
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
    /// Index of the first old pixel, or group of pixels, that is covered.
    first: usize,
    /// For `first` and for each old pixel or group after it: the covered part, in units of `1 / new` of a pixel,
    /// where `new` is the number of new pixels along the axis. These weights sum to the number of old pixels
    /// along the axis.
    weights: Vec<u32>,
}

/// The spans of `new` pixels over `old` pixels, which are joined in groups of `divisor`; the last group may be smaller.
fn spans(old: u32, divisor: u32, new: u32) -> Vec<Span> {
    let (old, new) = (u64::from(old), u64::from(new));
    let group = u64::from(divisor) * new;
    let span = |i: u64| {
        let (begin, end) = (i * old, (i + 1) * old);
        let touched = begin / group..end.div_ceil(group);
        let covered = |pixel: u64| ((pixel + 1) * group).min(end) - (pixel * group).max(begin);
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
    fn a_picture_of_joined_pixels_keeps_its_place() {
        // The last column and row of squares are not whole: 21 = 2 · 8 + 5, 10 = 8 + 2.
        let (old_px, size_px) = ([21, 10], [7, 5]);
        let ramp = (0..10).flat_map(|y| (0..21).flat_map(move |x| [10 * x, 20 * y, 100]));
        let exact = area_average(&Picture::new(old_px, ramp.collect()), size_px);
        // The mean of each square.
        let (columns, rows) = ([35, 115, 180], [70, 170]);
        let joined = rows.iter().flat_map(|y| columns.iter().flat_map(move |x| [*x, *y, 100]));
        let joined = area_average_of(&Picture::new([3, 2], joined.collect()), old_px, 8, size_px);
        let mean = |picture: &Picture, channel: usize| {
            picture.rgb.iter().skip(channel).step_by(3).map(|v| f64::from(*v)).sum::<f64>() / 35.0
        };
        for channel in 0..3 {
            assert!((mean(&exact, channel) - mean(&joined, channel)).abs() < 1.0, "channel {channel}");
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
