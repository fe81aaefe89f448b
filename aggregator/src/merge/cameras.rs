//! Centre and radius of a flight, from the positions of a model's cameras.

use cosurf_scene::Camera;
use glam::DVec3;

/// Mean position of the cameras, world units; the origin if there are no cameras.
pub(crate) fn middle(cameras: &[Camera]) -> DVec3 {
    cameras.iter().map(|camera| camera.cam_from_world.center()).sum::<DVec3>() / cameras.len().max(1) as f64
}

/// Distance from `middle` to the farthest camera, world units.
pub(crate) fn radius(cameras: &[Camera], middle: DVec3) -> f64 {
    cameras.iter().map(|camera| camera.cam_from_world.center().distance(middle)).fold(0.0, f64::max)
}
