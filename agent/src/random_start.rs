//! Random points to start a training from, for datasets without sparse points.
//!
//! The scale of the scene is unknown, so points lie at any depth from the distance of neighbouring cameras to many times of
//! it, where several cameras see them. Training moves splats that are near a surface onto it, and removes the others.
//!
//! What it knows nothing about: splats and files.

#![cfg_attr(not(test), warn(clippy::disallowed_methods))]

use cosurf_scene::{Camera, SparsePoint, evenly_spaced};
use glam::DVec2;

/// Points for each camera. With many more than the scene needs, training spends its steps on removing them: for 21 views and
/// 600 steps, 10,000 points gave 20.5 dB and 100,000 gave 16.4.
const POINTS_PER_CAMERA: usize = 500;
/// Fewest and most points; 3DGS takes 100,000 for its synthetic scenes.
const POINTS: [usize; 2] = [10_000, 100_000];
/// Attempts for each point; most succeed where photographs overlap.
const ATTEMPTS: usize = 8;
/// Smallest and largest depth, as multiples of the distance between neighbouring cameras. Drones that photograph with 80 %
/// of overlap are about 5 such distances above the ground, cameras around an object 10 to 30 from it.
const DEPTHS: [f64; 2] = [2.0, 32.0];
/// Most cameras that must see a point, a third of all if those are fewer. With 6 instead of 3, the scene of 21 views got
/// 22.3 dB instead of 20.5.
const SEEN_BY: usize = 6;
/// Cameras that are asked whether they see a point: of many, some at even intervals.
const CAMERAS_MAX: usize = 200;

/// Points in the common view of the cameras, the same for the same seed; none if all cameras are in one place.
pub(crate) fn points(cameras: &[Camera], seed: u64) -> Vec<SparsePoint> {
    let nearest = spacing(cameras);
    let cameras = evenly_spaced(cameras, CAMERAS_MAX);
    if cameras.is_empty() || nearest <= 0.0 {
        return Vec::new();
    }
    let [seen_by_min, count] = counts(cameras.len());
    let mut random = fastrand::Rng::with_seed(seed);
    let attempt = |_| {
        let camera = &cameras[random.usize(..cameras.len())];
        let size_px = DVec2::from(camera.size_px.map(f64::from));
        let at_px = DVec2::new(random.f64(), random.f64()) * size_px;
        let depth = nearest * DEPTHS[0] * libm::pow(DEPTHS[1] / DEPTHS[0], random.f64());
        let position = camera.unproject(at_px, depth);
        let seen_by = cameras.iter().filter(|camera| camera.sees(position)).take(seen_by_min).count();
        (seen_by == seen_by_min).then_some(SparsePoint { position, rgb: [128; 3], views: Vec::new() })
    };
    (0..count * ATTEMPTS).filter_map(attempt).take(count).collect()
}

/// By how many of some cameras a point must be seen, and the number of points.
fn counts(cameras: usize) -> [usize; 2] {
    [(cameras / 3).clamp(2, SEEN_BY), (POINTS_PER_CAMERA * cameras).clamp(POINTS[0], POINTS[1])]
}

/// Median distance of a camera from the nearest other one, world units; 0 if there are no two places.
fn spacing(cameras: &[Camera]) -> f64 {
    let centers: Vec<_> = cameras.iter().map(|camera| camera.cam_from_world.center()).collect();
    let nearest = |center: &glam::DVec3| {
        let others = centers.iter().map(|other| other.distance(*center)).filter(|distance| *distance > 0.0);
        others.min_by(f64::total_cmp)
    };
    let mut distances: Vec<f64> = evenly_spaced(cameras, CAMERAS_MAX)
        .iter()
        .filter_map(|camera| nearest(&camera.cam_from_world.center()))
        .collect();
    distances.sort_by(f64::total_cmp);
    distances.get(distances.len() / 2).copied().unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use cosurf_scene::Pose;
    use glam::DVec3;

    use super::*;

    /// Cameras 10 above the ground in a row, 2 apart, that look straight down.
    fn row(count: u32) -> Vec<Camera> {
        let camera = |i: u32| {
            let eye = DVec3::new(2.0 * f64::from(i), 0.0, 10.0);
            Camera {
                cam_from_world: Pose::look_at(eye, eye - DVec3::Z, DVec3::Y),
                focal_px: DVec2::splat(100.0),
                center_px: DVec2::new(50.0, 40.0),
                size_px: [100, 80],
            }
        };
        (0..count).map(camera).collect()
    }

    #[test]
    fn points_lie_where_several_cameras_see_them_and_depend_on_the_seed_alone() {
        let cameras = row(6);
        let found = points(&cameras, 1);
        assert!(found.len() > POINTS[0] / 2, "{}", found.len());
        for point in found.iter().step_by(997) {
            assert!(cameras.iter().filter(|camera| camera.sees(point.position)).count() >= 2);
        }
        let near_ground = found.iter().filter(|point| point.position.z.abs() < 2.0).count();
        assert!(near_ground > found.len() / 50, "{near_ground} of {}", found.len());
        assert_eq!(points(&cameras, 1), found);
        assert_ne!(points(&cameras, 2), found);
    }

    #[test]
    fn cameras_in_one_place_give_no_points() {
        assert!(points(&[row(1)[0]; 3], 1).is_empty());
        assert!(points(&[], 1).is_empty());
    }
}
