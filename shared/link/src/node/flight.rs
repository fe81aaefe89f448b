//! What a device tells of its flight.

use cosurf_scene::Camera;
use cosurf_wire::FLIGHT_CAMERAS_MAX;
use cosurf_wire::body::CAMERA_BYTES;

use crate::body::camera_record;

/// The cameras that a flight tells: all, or as many as it may, evenly spread.
pub fn told_cameras(cameras: &[Camera]) -> Vec<Camera> {
    let count = cameras.len().min(FLIGHT_CAMERAS_MAX);
    (0..count).map(|i| cameras[i * cameras.len() / count]).collect()
}

pub(super) fn camera_bytes(cameras: &[Camera]) -> Vec<u8> {
    let mut bytes = vec![0; cameras.len() * CAMERA_BYTES];
    for (camera, out) in cameras.iter().zip(bytes.as_chunks_mut().0) {
        camera_record(camera).encode(out);
    }
    bytes
}
