//! The message that tells a device its cell of the site's plan: the part of the ground that it observes.
//!
//! The aggregator sends the plan in answer to the start of a device's session ([`crate::State`]). The plan repeats the
//! number of that session, so a recorded plan never counts in a later one. A device without an answer repeats the start
//! of its session.

use serde::{Deserialize, Serialize};

use crate::id::{DeviceId, FrameId};

/// Largest number of corners of a cell.
pub const PLAN_CORNERS_MAX: usize = 64;
/// Limit on the absolute value of each coordinate of a corner, world units: more than the size of the earth.
pub const PLAN_COORDINATE_MAX: f64 = 1e8;
/// Encoded size of a corner in bytes: two coordinates as `f64`, little-endian.
const CORNER_BYTES: usize = 16;

/// The cell of one device.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Plan<'a> {
    /// The device that the message is for.
    pub device: DeviceId,
    /// Session of that device that the message is for, from its [`crate::State`].
    pub session: u64,
    /// The world frame of the site.
    pub frame: FrameId,
    /// The vertical axis of the world frame. The other two are the axes of the cell.
    pub vertical: VerticalAxis,
    /// Width of the margin around the cell, as a share of the cell's size, 0 to 1. The device also observes the margin.
    pub margin: f64,
    /// The encoded corners, in order around the cell: see [`Self::encode_corner`]. Empty if the plan has no cell for the
    /// device; otherwise 3 to [`PLAN_CORNERS_MAX`] corners.
    pub cell: &'a [u8],
}

/// An axis of the world.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum VerticalAxis {
    /// The first axis.
    X,
    /// The second axis.
    Y,
    /// The third axis.
    Z,
}

impl VerticalAxis {
    /// Index of the axis: 0, 1 or 2.
    pub fn index(self) -> usize {
        match self {
            Self::X => 0,
            Self::Y => 1,
            Self::Z => 2,
        }
    }
}

impl Plan<'_> {
    /// Encodes a corner of a cell.
    pub fn encode_corner([first, second]: [f64; 2]) -> [u8; CORNER_BYTES] {
        let mut bytes = [0; CORNER_BYTES];
        let (left, right) = bytes.split_at_mut(CORNER_BYTES / 2);
        left.copy_from_slice(&first.to_le_bytes());
        right.copy_from_slice(&second.to_le_bytes());
        bytes
    }

    /// Decodes the corners of the cell, in horizontal world coordinates.
    pub fn corners(&self) -> impl ExactSizeIterator<Item = [f64; 2]> {
        let (numbers, _) = self.cell.as_chunks::<{ CORNER_BYTES / 2 }>();
        numbers.as_chunks().0.iter().map(|[first, second]| [first, second].map(|it| f64::from_le_bytes(*it)))
    }

    /// Whether the cell has no corner, or 3 to [`PLAN_CORNERS_MAX`] whole ones within [`PLAN_COORDINATE_MAX`], and the
    /// margin is a share.
    pub(crate) fn is_sane(&self) -> bool {
        let is_near = |corner: [f64; 2]| corner.iter().all(|it| it.abs() <= PLAN_COORDINATE_MAX);
        self.cell.len().is_multiple_of(CORNER_BYTES)
            && matches!(self.corners().len(), 0 | 3..=PLAN_CORNERS_MAX)
            && self.corners().all(is_near)
            && (0.0..=1.0).contains(&self.margin)
    }
}
