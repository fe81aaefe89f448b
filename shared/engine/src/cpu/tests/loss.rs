//! Compares the colour loss with a direct f64 implementation, and its gradient with central differences.

use cosurf_scene::picture::MASKED;

use super::super::loss::Photometric;
use crate::backend::{Exposure, TargetRgb};
use crate::layout::tiles::TileImage;
use crate::random::{Purpose, Random};
use crate::simd::Isa;

const SIZE_PX: [usize; 2] = [37, 41];
const WEIGHT: f32 = 0.2;
const EXPOSURE: Exposure = Exposure { gain: 1.2, offset: -0.07 };

/// The colour loss of a rendering `x` and a photograph `y` by its definition. SSIM has an 11 × 11 window at every pixel
/// and zeros outside the picture. L1 compares `gain * x + offset` with `y`.
fn loss(x: &[f64], y: &[f64], gain: f64, offset: f64) -> f64 {
    let [width, height] = SIZE_PX;
    let raw: Vec<f64> = (0..11).map(|i| (-(f64::from(i) - 5.0).powi(2) / 4.5).exp()).collect();
    let sum: f64 = raw.iter().sum();
    let at = |v: &[f64], c: usize, px: isize, py: isize| {
        let inside = px >= 0 && py >= 0 && px < width as isize && py < height as isize;
        if inside { v[3 * (py as usize * width + px as usize) + c] } else { 0.0 }
    };
    let (mut ssim, mut l1) = (0.0, 0.0);
    for c in 0..3 {
        for py in 0..height as isize {
            for px in 0..width as isize {
                let (mut mx, mut my, mut xx, mut yy, mut xy) = (0.0, 0.0, 0.0, 0.0, 0.0);
                for (j, wj) in raw.iter().enumerate() {
                    for (i, wi) in raw.iter().enumerate() {
                        let w = wi * wj / (sum * sum);
                        let (a, b) = (px + i as isize - 5, py + j as isize - 5);
                        let (vx, vy) = (at(x, c, a, b), at(y, c, a, b));
                        mx += w * vx;
                        my += w * vy;
                        xx += w * vx * vx;
                        yy += w * vy * vy;
                        xy += w * vx * vy;
                    }
                }
                ssim += (2.0 * mx * my + 1e-4) * (2.0 * (xy - mx * my) + 9e-4)
                    / ((mx * mx + my * my + 1e-4) * (xx - mx * mx + yy - my * my + 9e-4));
                l1 += (gain * at(x, c, px, py) + offset - at(y, c, px, py)).abs();
            }
        }
    }
    let n = (3 * width * height) as f64;
    (1.0 - f64::from(WEIGHT)) * l1 / n + f64::from(WEIGHT) * (1.0 - ssim / n)
}

fn pictures() -> (Vec<f64>, Vec<f64>) {
    let mut random = Random::new(3, Purpose::Test, 0, 0);
    let n = 3 * SIZE_PX[0] * SIZE_PX[1];
    let x: Vec<f64> =
        (0..n).map(|i| f64::from(0.5 + 0.3 * (i as f32 * 0.02).sin() + 0.05 * random.normal())).collect();
    let y = x.iter().map(|v| (v + 0.2 * f64::from(random.normal())).clamp(0.0, 1.0)).collect();
    (x, y)
}

#[test]
fn loss_and_gradient_agree_with_the_definition() {
    for exposure in [Exposure::default(), EXPOSURE] {
        check(exposure);
    }
}

fn check(exposure: Exposure) {
    let (x, y) = pictures();
    let (gain, offset) = (f64::from(exposure.gain), f64::from(exposure.offset));
    let wanted = loss(&x, &y, gain, offset);
    let target: Vec<f32> = y.iter().map(|v| *v as f32).collect();
    let mut image = TileImage::with_capacity(0, 4);
    image.reshape(SIZE_PX.map(|side| side as u32), 4);
    for (i, value) in x.iter().enumerate() {
        image.set_value(i % 3, i / 3 % SIZE_PX[0], i / 3 / SIZE_PX[0], *value as f32);
    }
    // The padding of the tiles holds finite numbers too.
    image.rows_mut().iter_mut().for_each(|row| assert!(row.0.iter().all(|v| v.is_finite())));
    for isa in Isa::available() {
        let mut gradient = image.clone();
        let mut photometric = Photometric::with_capacity(SIZE_PX.map(|side| side as u32), 1);
        let got = photometric.loss(isa, &image, TargetRgb::Floats(&target), exposure, WEIGHT, &mut gradient);
        assert!((got.total - wanted).abs() < 1e-5, "{}: {} is not {wanted}", isa.name(), got.total);
        let mut worst: f64 = 0.0;
        for k in (0..x.len()).step_by(97).chain([0, 1, 2, x.len() - 1, 3 * SIZE_PX[0] - 1]) {
            let mut moved = x.clone();
            let mut at = |v: f64| {
                moved[k] = v;
                loss(&moved, &y, gain, offset)
            };
            let slope = (at(x[k] + 1e-4) - at(x[k] - 1e-4)) / 2e-4;
            let value = f64::from(gradient.value(k % 3, k / 3 % SIZE_PX[0], k / 3 / SIZE_PX[0]));
            worst = worst.max((value - slope).abs() / slope.abs().max(2e-6));
        }
        assert!(worst < 1e-3, "{}: relative error {worst:.2e}", isa.name());
        // The L1 loss has a kink where a rendered value equals the photograph's, so the differences for gain and offset
        // use a small step.
        let slope = |at: &dyn Fn(f64) -> f64| (at(1e-6) - at(-1e-6)) / 2e-6;
        let by_gain = slope(&|by| loss(&x, &y, gain + by, offset));
        let by_offset = slope(&|by| loss(&x, &y, gain, offset + by));
        assert!((got.by_gain - by_gain).abs() < 1e-3 * by_gain.abs(), "{} is not {by_gain}", got.by_gain);
        assert!(
            (got.by_offset - by_offset).abs() < 1e-3 * by_offset.abs(),
            "{} is not {by_offset}",
            got.by_offset
        );
        let [width, height] = SIZE_PX;
        assert_eq!(gradient.value(0, width, 5), 0.0, "padding has no gradient");
        assert_eq!(gradient.value(0, 5, height), 0.0, "padding has no gradient");
    }
}

#[test]
fn masked_pixels_add_nothing_and_get_no_gradient() {
    let [width, height] = SIZE_PX;
    let is_masked = |x: usize, y: usize| (9..20).contains(&x) && (12..30).contains(&y);
    let places = || (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
    let photograph: Vec<u8> = places()
        .flat_map(
            |(x, y)| if is_masked(x, y) { MASKED } else { [(6 * x) as u8, (5 * y) as u8, (x * y) as u8] },
        )
        .collect();
    // The rendering is the photograph, but for what the mask hides.
    let mut image = TileImage::with_capacity(0, 4);
    image.reshape(SIZE_PX.map(|side| side as u32), 4);
    for (i, value) in photograph.iter().enumerate() {
        let (x, y) = (i / 3 % width, i / 3 / width);
        let shown = if is_masked(x, y) { (i % 7) as f32 / 7.0 } else { f32::from(*value) * (1.0 / 255.0) };
        image.set_value(i % 3, x, y, shown);
    }
    for isa in Isa::available() {
        let loss = |image: &TileImage| {
            let mut gradient = image.clone();
            let mut photometric = Photometric::with_capacity(SIZE_PX.map(|side| side as u32), 1);
            let target = TargetRgb::Bytes(&photograph);
            (photometric.loss(isa, image, target, Exposure::default(), WEIGHT, &mut gradient), gradient)
        };
        let (same, gradient) = loss(&image);
        assert!(same.total.abs() < 1e-6 && same.mse < 1e-12, "{same:?}");
        let largest = places().flat_map(|(x, y)| (0..3).map(move |c| (c, x, y)));
        let largest = largest.map(|(c, x, y)| gradient.value(c, x, y).abs()).fold(0.0, f32::max);
        assert!(largest < 0.05 / (3 * width * height) as f32, "{largest}");
        let mut other = image.clone();
        places().for_each(|(x, y)| (0..3).for_each(|c| other.set_value(c, x, y, 0.4)));
        let (_, gradient) = loss(&other);
        for (x, y) in places() {
            let is_zero = (0..3).all(|c| gradient.value(c, x, y) == 0.0);
            assert_eq!(is_zero, is_masked(x, y), "at {x}, {y}");
        }
    }
}
