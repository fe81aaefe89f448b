//! Similarities: a rotation, one scale and a translation.

use glam::{DQuat, DVec3};

/// The map from the frame of a reconstruction to ENU of a site: `enu = scale * rotation * p + translation`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Similarity {
    /// Metres for each unit of the reconstruction, positive.
    pub scale: f64,
    /// Unit quaternion.
    pub rotation: DQuat,
    /// Metres.
    pub translation: DVec3,
}

impl Similarity {
    /// Maps a point of the reconstruction to ENU, metres.
    pub fn apply(&self, p: DVec3) -> DVec3 {
        self.scale * (self.rotation * p) + self.translation
    }
}
