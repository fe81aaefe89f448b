//! Lenses with distortion: COLMAP's camera model `OPENCV`.

use glam::{DMat2, DVec2};

/// Rounds of Newton's method; a lens of a drone takes four.
const ROUNDS: usize = 20;
/// Largest error of a ray, on the plane at distance 1.
const ERROR_MAX: f64 = 1e-9;

/// Pixels of cameras are square to 0.1 %. Focal lengths that differ by more are of poses that are wrong.
const ASPECT_MAX: f64 = 1.05;

/// A lens, as COLMAP's `src/colmap/sensor/models.h` and OpenCV define it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Lens {
    pub(super) size_px: [u32; 2],
    pub(super) focal_px: DVec2,
    pub(super) center_px: DVec2,
    /// k1, k2, p1, p2.
    pub(super) distortion: [f64; 4],
}

impl Lens {
    /// A line of `cameras.txt`: `id OPENCV width height fx fy cx cy k1 k2 p1 p2`. Returns the id, too.
    pub(super) fn parse(line: &str) -> Option<(u32, Self)> {
        let words: Vec<&str> = line.split_whitespace().collect();
        let [id, "OPENCV", width, height, numbers @ ..] = &words[..] else { return None };
        let size_px = [width.parse().ok()?, height.parse().ok()?];
        let numbers: Option<Vec<f64>> = numbers.iter().map(|word| word.parse().ok()).collect();
        let lens = Self::of_parameters(size_px, numbers?.try_into().ok()?)?;
        Some((id.parse().ok()?, lens))
    }

    /// fx, fy, cx, cy, k1, k2, p1, p2: the order of COLMAP's files.
    pub(super) fn parameters(&self) -> [f64; 8] {
        let ([fx, fy], [cx, cy], [k1, k2, p1, p2]) =
            (self.focal_px.to_array(), self.center_px.to_array(), self.distortion);
        [fx, fy, cx, cy, k1, k2, p1, p2]
    }

    /// The lens with these [`Self::parameters`]; `None` if they are none of a lens.
    pub(super) fn of_parameters(size_px: [u32; 2], parameters: [f64; 8]) -> Option<Self> {
        let [fx, fy, cx, cy, distortion @ ..] = parameters;
        let is_lens = fx > 0.0 && fy > 0.0 && parameters.iter().all(|number| number.is_finite());
        is_lens.then_some(Self {
            size_px,
            focal_px: DVec2::new(fx, fy),
            center_px: DVec2::new(cx, cy),
            distortion,
        })
    }

    /// Why no camera has such a lens; `None` if one may.
    pub(super) fn fault(&self) -> Option<String> {
        let DVec2 { x, y } = self.focal_px;
        let is_square = (x / y).max(y / x) < ASPECT_MAX;
        let reason = || format!("the focal length is {x:.0} pixels along x, but {y:.0} along y");
        (!is_square).then(reason)
    }

    /// The undistorted direction of a pixel, on the plane at distance 1; `None` if no direction leads there.
    pub(super) fn ray(&self, at_px: DVec2) -> Option<DVec2> {
        let wanted = (at_px - self.center_px) / self.focal_px;
        let mut ray = wanted;
        for _ in 0..ROUNDS {
            let (is, slope) = self.distort(ray);
            if (is - wanted).length() < ERROR_MAX {
                return Some(ray);
            }
            ray -= slope.inverse() * (is - wanted);
        }
        None
    }

    /// The distorted position of a direction, and its derivative.
    pub(super) fn distort(&self, ray: DVec2) -> (DVec2, DMat2) {
        let [k1, k2, p1, p2] = self.distortion;
        let DVec2 { x, y } = ray;
        let r2 = ray.length_squared();
        let radial = 1.0 + k1 * r2 + k2 * r2 * r2;
        let is = ray * radial
            + DVec2::new(
                2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
            );
        let grows = 2.0 * k1 + 4.0 * k2 * r2; // derivative of `radial`, over the ray
        let mixed = grows * x * y + 2.0 * p1 * x + 2.0 * p2 * y;
        let along_x = radial + grows * x * x + 2.0 * p1 * y + 6.0 * p2 * x;
        let along_y = radial + grows * y * y + 6.0 * p1 * y + 2.0 * p2 * x;
        (is, DMat2::from_cols(DVec2::new(along_x, mixed), DVec2::new(mixed, along_y)))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn lenses_of_wrong_poses_are_noticed() {
        let fault = |line: &str| Lens::parse(line).unwrap().1.fault();
        assert_eq!(fault("1 OPENCV 400 300 343.1 343.3 200 150 -0.06 0.01 0.004 -0.005"), None);
        // Of twelve photographs that COLMAP misunderstood; the lens has 350 pixels.
        let fault = fault("1 OPENCV 400 300 929.68 743.09 200 150 -0.62 0.01 0 -0.004").unwrap();
        assert_eq!(fault, "the focal length is 930 pixels along x, but 743 along y");
    }

    #[test]
    fn rays_are_those_that_the_lens_bends_to_the_pixel() {
        let line = "1 OPENCV 1280 960 935 930 640 480 -0.12 0.05 0.001 -0.002";
        let (id, lens) = Lens::parse(line).unwrap();
        assert_eq!(id, 1);
        for ray in [DVec2::ZERO, DVec2::new(0.6, -0.4), DVec2::new(-0.3, 0.5)] {
            let at_px = lens.distort(ray).0 * lens.focal_px + lens.center_px;
            assert!(lens.ray(at_px).unwrap().distance(ray) < 1e-8, "{ray}");
        }
        // By hand: 0.5 · (1 - 0.12 · 0.25 + 0.05 · 0.0625) + 3 · -0.002 · 0.25, and 0.001 · 0.25.
        let bent = lens.distort(DVec2::new(0.5, 0.0)).0;
        assert!(bent.distance(DVec2::new(0.485_062_5, 0.000_25)) < 1e-12, "{bent}");
        assert!(Lens::parse("1 PINHOLE 1280 960 935 930 640 480").is_none());
        assert!(Lens::parse("1 OPENCV 1280 960 935 930 640 480 nan 0 0 0").is_none());
    }
}
