//! How finely the cameras of a model claim to have seen a place, before anybody has checked it.

use cosurf_scene::{Camera, Frustum};
use glam::DVec3;

/// No claim is larger than this number of pixels, so that sums of cubes stay finite.
const PIXELS_MAX: f64 = 1e60;

/// The cameras of a model.
pub(super) struct Claims<'a> {
    cameras: &'a [Camera],
    frusta: Vec<Frustum>,
}

impl<'a> Claims<'a> {
    pub(super) fn new(cameras: &'a [Camera]) -> Self {
        Self { cameras, frusta: cameras.iter().map(Frustum::new).collect() }
    }

    /// Whether some point of a ball may lie in the picture of some camera.
    pub(super) fn touches(&self, center: DVec3, radius: f64) -> bool {
        self.frusta.iter().any(|frustum| frustum.touches(center, radius))
    }

    /// Number of pixels that the model claims to have on a square of one world unit at each of `places`; their geometric
    /// mean. `None` if no camera sees any of them.
    pub(super) fn pixels(&self, places: &[DVec3]) -> Option<f64> {
        let logs: Vec<f64> =
            places.iter().filter_map(|place| self.pixels_at(*place)).map(libm::log).collect();
        (!logs.is_empty()).then(|| libm::exp(logs.iter().sum::<f64>() / logs.len() as f64))
    }

    /// The mean of all cameras that see the place, in which each counts as much as its observation is worth, by its claim:
    /// with the square of the pixels. A hundred coarse cameras do not cover up a fine one.
    fn pixels_at(&self, place: DVec3) -> Option<f64> {
        let seeing = self.cameras.iter().zip(&self.frusta).filter(|(_, frustum)| frustum.contains(place));
        let [mut worth, mut sum] = [0.0; 2];
        for (camera, _) in seeing {
            let pixels =
                camera.focal_px.element_product() / camera.cam_from_world.center().distance_squared(place);
            let pixels = pixels.min(PIXELS_MAX);
            worth += pixels.powi(2);
            sum += pixels.powi(3);
        }
        let mean = sum / worth;
        (mean.is_finite() && mean > 0.0).then_some(mean)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::testing::above;

    #[test]
    fn many_coarse_cameras_do_not_cover_up_a_fine_one() {
        let coarse = above(0.0);
        let place = coarse.unproject(coarse.center_px, 5.0);
        let pixels = |cameras: &[Camera]| Claims::new(cameras).pixels(&[place]);
        let one = pixels(&[coarse]).unwrap();
        assert!((one * 25.0 / coarse.focal_px.element_product() - 1.0).abs() < 1e-9);
        let mut cameras = vec![coarse; 100];
        assert!((pixels(&cameras).unwrap() / one - 1.0).abs() < 1e-9);
        cameras.push(coarse.resized(coarse.size_px.map(|side| 8 * side)));
        assert!(pixels(&cameras).unwrap() > 60.0 * one);
    }

    #[test]
    fn cameras_that_see_nothing_of_a_place_claim_nothing() {
        let camera = above(0.0);
        let behind = camera.unproject(camera.center_px, -5.0);
        assert_eq!(Claims::new(&[camera]).pixels(&[behind]), None);
        assert_eq!(Claims::new(&[camera]).pixels(&[]), None);
    }

    #[test]
    fn a_claim_beyond_reason_is_a_number() {
        let camera = above(0.0);
        let absurd = Camera { focal_px: glam::DVec2::splat(1e200), ..camera };
        let place = camera.unproject(camera.center_px, 5.0);
        assert!(Claims::new(&[absurd, camera]).pixels(&[place]).unwrap() > 1e59);
    }
}
