//! Models as they travel: their content, what can be wrong with a body, and cameras as records.

use cosurf_scene::{Camera, Pose, Splats};
use cosurf_wire::BodyHash;
use cosurf_wire::body::{BodyError, CameraRecord};
use glam::{DQuat, DVec2, DVec3};

/// What travels of a model: splats and the cameras that saw them; pictures stay home.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Model {
    /// The splats.
    pub splats: Splats,
    /// The cameras of the training views.
    pub cameras: Vec<Camera>,
}

/// What is wrong with a body.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum BodyFault {
    /// Its layout.
    #[error(transparent)]
    Layout(#[from] BodyError),
    /// Its counts, degree or bounds differ from those announced.
    #[error("body and header disagree")]
    NotAsAnnounced,
    /// A camera that no renderer could use.
    #[error("camera {index} is not finite, has no rotation, or an empty picture")]
    Camera {
        /// Which.
        index: usize,
    },
    /// A value that no renderer could use.
    #[error("{field} of splat {index} is not finite or out of range")]
    Splat {
        /// Which.
        index: usize,
        /// Its field, as in [`Splats`].
        field: &'static str,
    },
    /// A mean outside the announced bounds.
    #[error("splat {index} of a pack lies outside the announced bounds")]
    OutOfBounds {
        /// Which of its pack.
        index: usize,
    },
    /// More splats or cameras than a `u32` counts.
    #[error("more splats or cameras than a body can count")]
    TooMany,
    /// The compressor failed, for want of memory.
    #[error("the body could not be compressed: there is too little memory")]
    Unpackable,
}

/// BLAKE3 of a body.
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
