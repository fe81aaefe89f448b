//! The box that contains a model.

use serde::{Deserialize, Serialize};

/// A closed axis-aligned box in the world frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Bounds {
    /// Smallest x, y and z, world units.
    pub min: [f32; 3],
    /// Largest x, y and z, world units.
    pub max: [f32; 3],
}

impl Bounds {
    /// Whether both corners are finite and no minimum exceeds its maximum.
    pub fn is_sane(&self) -> bool {
        (0..3).all(|k| self.min[k].is_finite() && self.max[k].is_finite() && self.min[k] <= self.max[k])
    }

    /// Whether a point is inside the box or on its surface; `false` for NaN.
    pub fn contains(&self, point: [f32; 3]) -> bool {
        (0..3).all(|k| point[k] >= self.min[k] && point[k] <= self.max[k])
    }

    /// The point of the box that is nearest to `point`.
    pub fn clamp(&self, point: [f32; 3]) -> [f32; 3] {
        core::array::from_fn(|k| point[k].clamp(self.min[k], self.max[k]))
    }
}
