//! The cameras that a device announces to other devices, selected from its own flight.

use cosurf_scene::{Camera, evenly_spaced};
use cosurf_wire::body::CAMERA_BYTES;
use cosurf_wire::{BodyHash, FLIGHT_CAMERAS_MAX};

use crate::body::{body_hash, camera_record};

/// Selects the cameras to announce: all of them, or [`FLIGHT_CAMERAS_MAX`] at even intervals.
pub fn select_flight_cameras(cameras: &[Camera]) -> Vec<Camera> {
    evenly_spaced(cameras, FLIGHT_CAMERAS_MAX)
}

/// The hash by which the flight with these cameras is pledged and confirmed.
pub fn flight_hash(cameras: &[Camera]) -> BodyHash {
    body_hash(&camera_bytes(&select_flight_cameras(cameras)))
}

/// Encodes cameras for a flight message.
pub(super) fn camera_bytes(cameras: &[Camera]) -> Vec<u8> {
    let mut bytes = vec![0; cameras.len() * CAMERA_BYTES];
    for (camera, out) in cameras.iter().zip(bytes.as_chunks_mut().0) {
        camera_record(camera).encode(out);
    }
    bytes
}
