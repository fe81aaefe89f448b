//! Picture quality (PSNR, SSIM) as the original 3DGS code measures it on held-out views.

use glam::DVec3;

use crate::Picture;

/// Side of SSIM's square window, pixels.
const WINDOW: usize = 11;

/// Standard deviation of SSIM's Gaussian window, pixels.
const SIGMA_PX: f64 = 1.5;

/// SSIM's constant C1 for values 0 to 1 (Wang et al. 2004). It keeps the quotient of the means defined where
/// both pictures are black.
const C1: f64 = 0.01 * 0.01;
/// SSIM's constant C2 for values 0 to 1. It keeps the quotient of covariance and variances defined where both
/// pictures are flat.
const C2: f64 = 0.03 * 0.03;

/// Number of maps that SSIM blurs to get local means: `a`, `b`, `a²`, `b²` and `ab`, for pictures `a` and
/// `b`.
const MAPS: usize = 5;

/// Peak signal-to-noise ratio in dB of two pictures with values 0 to 1: `20 log10(1 / sqrt(mse))`, where
/// `mse` is the mean squared difference over all values of all channels. Infinite if the pictures are equal.
///
/// Panics if the lengths differ or are 0.
pub fn psnr(a: &[f32], b: &[f32]) -> f64 {
    assert_eq!(a.len(), b.len(), "two pictures must have as many values");
    assert!(!a.is_empty(), "a picture must have pixels");
    let squares = a.iter().zip(b).map(|(&a, &b)| (f64::from(a) - f64::from(b)).powi(2));
    let mse = squares.sum::<f64>() / a.len() as f64;
    -10.0 * libm::log10(mse)
}

/// [`psnr`] and [`ssim`] of a rendering against a photograph, over the pixels of the photograph that count. In the windows
/// of SSIM around them, the others look the same in both.
///
/// Panics if the rendering has another size than the photograph, or if no pixel counts; [`crate::mask::read`] refuses such
/// photographs.
pub fn scores(rendering: &[f32], photograph: &Picture) -> [f64; 2] {
    let mut wanted = photograph.to_unit();
    let counted: Vec<bool> = photograph.counted().collect();
    let count = counted.iter().filter(|counts| **counts).count();
    if count == counted.len() {
        return [psnr(rendering, &wanted), ssim(rendering, &wanted, photograph.size_px)];
    }
    let pixels = wanted.as_chunks_mut::<3>().0.iter_mut().zip(rendering.as_chunks::<3>().0).zip(&counted);
    pixels.filter(|(_, counts)| !**counts).for_each(|((wanted, shown), _)| *wanted = *shown);
    assert!(count > 0, "no pixel of the photograph counts");
    let share = count as f64 / counted.len() as f64;
    let total = ssim_where(rendering, &wanted, photograph.size_px, |pixel| counted[pixel]);
    [psnr(rendering, &wanted) + 10.0 * libm::log10(share), total / (3 * count) as f64]
}

/// [`psnr`] of one plain colour, the mean of the photograph, against the photograph, over its pixels that count: what a model
/// that has learnt nothing reaches. Infinite for a plain photograph.
///
/// Panics if no pixel counts; [`crate::mask::read`] refuses such photographs.
pub fn plain_psnr(photograph: &Picture) -> f64 {
    let values = photograph.to_unit();
    let pixels = values.as_chunks::<3>().0.iter().zip(photograph.counted());
    let (mut count, mut sum, mut squares) = (0.0, DVec3::ZERO, 0.0);
    for (rgb, _) in pixels.filter(|(_, counts)| *counts) {
        let rgb = DVec3::from_array(rgb.map(f64::from));
        (count, sum, squares) = (count + 1.0, sum + rgb, squares + rgb.length_squared());
    }
    assert!(count > 0.0, "no pixel of the photograph counts");
    let mse = (squares / count - (sum / count).length_squared()) / 3.0;
    -10.0 * libm::log10(mse.max(0.0))
}

/// Mean structural similarity of two pictures `[height, width, rgb]` with values 0 to 1; 1 if they are
/// equal. The window is Gaussian, of 11 × 11 pixels and σ = 1.5 px, with zeros beyond the border; C1 = 0.01²
/// and C2 = 0.03². The mean is over all pixels and channels.
///
/// Panics if a length is 0 or not `3 · width · height`.
pub fn ssim(a: &[f32], b: &[f32], size_px: [u32; 2]) -> f64 {
    ssim_where(a, b, size_px, |_| true) / a.len() as f64
}

/// Sum of SSIM over all channels of the pixels that count.
fn ssim_where(a: &[f32], b: &[f32], size_px: [u32; 2], counts: impl Fn(usize) -> bool) -> f64 {
    let [width, height] = size_px.map(|side| side as usize);
    let row = 3 * width;
    assert!(a.len() == row * height && b.len() == a.len(), "both pictures must have {size_px:?} pixels");
    assert!(!a.is_empty(), "a picture must have pixels");
    let window = window();
    let mut blur = RowBlur::new(row);
    // Ring buffer of the latest `WINDOW` rows, blurred along x. Rows outside the picture are zero.
    let mut ring = vec![vec![0.0; MAPS * row]; WINDOW];
    let mut blurred = vec![0.0; MAPS * row];
    let mut sum = 0.0;
    for y in 0..height + WINDOW / 2 {
        let newest = &mut ring[y % WINDOW];
        if y < height {
            let pixels = y * row..(y + 1) * row;
            blur.run(&window, &a[pixels.clone()], &b[pixels], newest);
        } else {
            newest.fill(0.0);
        }
        if y >= WINDOW / 2 {
            let oldest_first = (0..WINDOW).map(|k| &ring[(y + 1 + k) % WINDOW][..]);
            weighted_sum(&window, oldest_first, &mut blurred);
            let first = (y - WINDOW / 2) * width;
            sum += sum_of_row(&blurred, row, |i| counts(first + i / 3));
        }
    }
    sum
}

/// Weights of the Gaussian window along one axis, summing to 1.
fn window() -> [f64; WINDOW] {
    let center = (WINDOW / 2) as f64;
    let weights: [f64; WINDOW] =
        std::array::from_fn(|i| libm::exp(-(i as f64 - center).powi(2) / (2.0 * SIGMA_PX * SIGMA_PX)));
    let sum: f64 = weights.iter().sum();
    weights.map(|weight| weight / sum)
}

/// `out = Σ weights[k] · rows[k]`, summed row by row in loops that the compiler vectorises.
fn weighted_sum<'a>(weights: &[f64], rows: impl Iterator<Item = &'a [f64]>, out: &mut [f64]) {
    out.fill(0.0);
    for (weight, row) in weights.iter().zip(rows) {
        out.iter_mut().zip(row).for_each(|(out, value)| *out += weight * value);
    }
}

/// Blurs the five maps of a row along x. The channels of a row stay interleaved, so the next pixel's value
/// of the same channel is three values away.
struct RowBlur {
    /// A row of one map, with zeros for half a window on both sides.
    padded: Vec<f64>,
}

impl RowBlur {
    fn new(row: usize) -> Self {
        Self { padded: vec![0.0; row + 3 * (WINDOW - 1)] }
    }

    fn run(&mut self, window: &[f64; WINDOW], a: &[f32], b: &[f32], out: &mut [f64]) {
        let products: [fn(f64, f64) -> f64; MAPS] =
            [|a, _| a, |_, b| b, |a, _| a * a, |_, b| b * b, |a, b| a * b];
        let margin = 3 * (WINDOW / 2);
        for (out, product) in out.chunks_exact_mut(a.len()).zip(products) {
            for ((padded, &a), &b) in self.padded[margin..].iter_mut().zip(a).zip(b) {
                *padded = product(f64::from(a), f64::from(b));
            }
            weighted_sum(window, (0..WINDOW).map(|k| &self.padded[3 * k..]), out);
        }
    }
}

/// Sum of SSIM over the values of one row that count, computed from the row's blurred maps.
fn sum_of_row(blurred: &[f64], row: usize, counts: impl Fn(usize) -> bool) -> f64 {
    let [a, b, aa, bb, ab] = std::array::from_fn(|map| &blurred[map * row..(map + 1) * row]);
    let at = |i: usize| {
        let (mean_ab, mean_aa, mean_bb) = (a[i] * b[i], a[i] * a[i], b[i] * b[i]);
        let (var_a, var_b, cov) = (aa[i] - mean_aa, bb[i] - mean_bb, ab[i] - mean_ab);
        (2.0 * mean_ab + C1) * (2.0 * cov + C2) / ((mean_aa + mean_bb + C1) * (var_a + var_b + C2))
    };
    (0..row).filter(|i| counts(*i)).map(at).sum()
}

#[cfg(test)]
mod tests {
    //! Tests against a direct, non-separable implementation of the definition.

    use super::*;
    use crate::picture::MASKED;

    /// A pseudo-random value between 0 and 1 that depends only on `i`.
    fn noise(i: usize) -> f32 {
        let hashed = (i as u64 + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
        ((hashed ^ (hashed >> 29)).wrapping_mul(0xBF58_476D_1CE4_E5B9) >> 40) as f32 / (1 << 24) as f32
    }

    fn pair(size_px: [u32; 2]) -> (Vec<f32>, Vec<f32>) {
        let n = 3 * (size_px[0] * size_px[1]) as usize;
        let a: Vec<f32> = (0..n).map(noise).collect();
        let b = a.iter().enumerate().map(|(i, a)| 0.7 * a + 0.3 * noise(i + n)).collect();
        (a, b)
    }

    /// SSIM straight from its definition: a double loop over the window for each pixel and channel.
    fn ssim_direct(a: &[f32], b: &[f32], size_px: [u32; 2]) -> f64 {
        let [width, height] = size_px.map(i64::from);
        let weight = |dx: i64, dy: i64| (-((dx * dx + dy * dy) as f64) / 4.5).exp();
        let total: f64 = (-5..=5).flat_map(|dy| (-5..=5).map(move |dx| weight(dx, dy))).sum();
        let mut sum = 0.0;
        for (x, y, c) in
            (0..height).flat_map(|y| (0..width).flat_map(move |x| (0..3).map(move |c| (x, y, c))))
        {
            let mut m = [0.0; 5];
            for (dx, dy) in (-5..=5).flat_map(|dy| (-5..=5).map(move |dx| (dx, dy))) {
                if !(0..width).contains(&(x + dx)) || !(0..height).contains(&(y + dy)) {
                    continue;
                }
                let at = (3 * ((y + dy) * width + x + dx) + c) as usize;
                let (a, b, w) = (f64::from(a[at]), f64::from(b[at]), weight(dx, dy) / total);
                for (m, v) in m.iter_mut().zip([a, b, a * a, b * b, a * b]) {
                    *m += w * v;
                }
            }
            let [a, b, aa, bb, ab] = m;
            sum += (2.0 * a * b + 0.0001) / (a * a + b * b + 0.0001) * (2.0 * (ab - a * b) + 0.0009)
                / (aa - a * a + bb - b * b + 0.0009);
        }
        sum / a.len() as f64
    }

    #[test]
    fn ssim_is_as_defined() {
        for size_px in [[1, 1], [3, 2], [11, 11], [7, 23], [31, 17]] {
            let (a, b) = pair(size_px);
            let (fast, direct) = (ssim(&a, &b, size_px), ssim_direct(&a, &b, size_px));
            assert!((fast - direct).abs() < 1e-10, "{size_px:?}: {fast} is not {direct}");
            assert!(direct < 0.999, "{size_px:?}: the pair must differ");
        }
    }

    #[test]
    fn pixels_that_do_not_count_change_no_score() {
        let size_px = [24, 16];
        let (a, b) = pair(size_px);
        let mut photograph = Picture::from_unit(size_px, &b);
        let all = scores(&a, &photograph);
        let wanted = photograph.to_unit();
        assert_eq!(all, [psnr(&a, &wanted), ssim(&a, &wanted, size_px)]);
        let hidden = |i: usize| i / 3 % 24 < 12;
        (0..a.len()).filter(|i| hidden(*i)).for_each(|i| photograph.rgb[i] = MASKED[i % 3]);
        let [psnr_half, ssim_half] = scores(&a, &photograph);
        let right: Vec<usize> = (0..a.len()).filter(|i| !hidden(*i)).collect();
        let [a_right, b_right] = [&a, &wanted].map(|of| right.iter().map(|i| of[*i]).collect::<Vec<f32>>());
        assert!((psnr_half - psnr(&a_right, &b_right)).abs() < 1e-9);
        let mut garbage = a.clone();
        (0..a.len()).filter(|i| hidden(*i) && i / 3 % 24 < 6).for_each(|i| garbage[i] = 0.9);
        let changed = scores(&garbage, &photograph);
        assert!((changed[0] - psnr_half).abs() < 1e-9, "{changed:?}");
        assert!(
            (changed[1] - ssim_half).abs() < 1e-9,
            "the windows of the pixels that count do not reach so far"
        );
    }

    #[test]
    fn equal_pictures_are_perfect() {
        let (a, _) = pair([9, 8]);
        assert_eq!(psnr(&a, &a), f64::INFINITY);
        assert!((ssim(&a, &a, [9, 8]) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn psnr_is_as_defined() {
        let a = [0.0, 0.5, 1.0];
        assert!((psnr(&a, &[0.1, 0.6, 0.9]) - 20.0).abs() < 1e-5);
        assert!(psnr(&[0.0; 3], &[1.0; 3]).abs() < 1e-12);
        // One value in four is off by a half: mse 1/16.
        let expected = 20.0 * (1.0 / 0.25_f64).log10();
        assert!((psnr(&[0.0; 4], &[0.0, 0.0, 0.5, 0.0]) - expected).abs() < 1e-12);
    }

    #[test]
    fn one_plain_colour_is_as_good_as_the_spread_of_the_pixels_that_count() {
        let of = |pixels: &[[u8; 3]]| {
            plain_psnr(&Picture::new([pixels.len() as u32, 1], pixels.as_flattened().to_vec()))
        };
        let half_db = 20.0 * 2.0_f64.log10();
        assert!((of(&[[0; 3], [255; 3]]) - half_db).abs() < 1e-12);
        assert!((of(&[[0; 3], MASKED, [255; 3]]) - half_db).abs() < 1e-12);
        assert_eq!(of(&[[255; 3], MASKED]), f64::INFINITY);
    }

    #[test]
    fn black_against_white_has_an_ssim_near_zero() {
        let n = 3 * 40 * 40;
        let got = ssim(&vec![0.0; n], &vec![1.0; n], [40, 40]);
        assert!((0.0..0.01).contains(&got), "{got}");
    }
}
