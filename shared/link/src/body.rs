//! The content of a transmitted model, the errors of a body, and the conversion of cameras to and from their
//! encoded form.

use cosurf_scene::{Camera, Pose, Splats};
use cosurf_wire::BodyHash;
use cosurf_wire::body::{BodyError, CameraRecord};
use glam::{DQuat, DVec2, DVec3};

/// The transmitted part of a model: its splats and the cameras of its pictures. Pictures are never sent.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Model {
    /// The splats, in the frame that the model was decoded into.
    pub splats: Splats,
    /// The cameras of the training pictures, in the same frame.
    pub cameras: Vec<Camera>,
}

/// Why a body is invalid or cannot be made.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum BodyFault {
    /// The layout is invalid.
    #[error(transparent)]
    Layout(#[from] BodyError),
    /// The number of splats or cameras, the degree of the spherical harmonics, or the bounds in the body
    /// differ from those in the header.
    #[error("body and header disagree")]
    NotAsAnnounced,
    /// A camera is not usable for rendering.
    #[error("camera {index} is not finite, has no valid rotation, or has an empty picture")]
    Camera {
        /// Index of the camera.
        index: usize,
    },
    /// A splat is not usable for rendering.
    #[error("{field} of splat {index} is not finite or out of range")]
    Splat {
        /// Index of the splat.
        index: usize,
        /// Name of the invalid field in [`Splats`], in the singular, for example `log_scale`.
        field: &'static str,
    },
    /// A splat's mean is outside the bounds in the header.
    #[error("splat {index} of a pack lies outside the bounds in the header")]
    OutOfBounds {
        /// Index of the splat in its pack.
        index: usize,
    },
    /// The origin is not a position on earth.
    #[error("the origin is farther away than 100,000 km")]
    Origin,
    /// More splats or cameras than a `u32` can count, or more packs than a `u16` can count.
    #[error("more splats or cameras than a body can count")]
    TooMany,
    /// A list of tiles contradicts itself.
    #[error("the list of tiles is malformed")]
    Manifest,
    /// The compressor ran out of memory.
    #[error("too little memory to compress the body")]
    Unpackable,
}

/// BLAKE3 hash of a body.
pub fn body_hash(body: &[u8]) -> BodyHash {
    BodyHash(*blake3::hash(body).as_bytes())
}

pub(crate) fn camera_record(camera: &Camera) -> CameraRecord {
    let Pose { rotation: q, translation } = camera.cam_from_world;
    CameraRecord {
        quat: [q.w, q.x, q.y, q.z],
        translation: translation.to_array(),
        focal_px: camera.focal_px.to_array(),
        center_px: camera.center_px.to_array(),
        size_px: camera.size_px,
    }
}

pub(crate) fn camera(record: &CameraRecord) -> Camera {
    let [w, x, y, z] = record.quat;
    Camera {
        cam_from_world: Pose {
            rotation: DQuat::from_xyzw(x, y, z, w),
            translation: DVec3::from_array(record.translation),
        },
        focal_px: DVec2::from_array(record.focal_px),
        center_px: DVec2::from_array(record.center_px),
        size_px: record.size_px,
    }
}
