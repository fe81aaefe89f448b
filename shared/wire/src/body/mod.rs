//! How a model (splats and the cameras that saw them, never pictures) is laid out in bytes: whole numbers
//! in *packs* that stand alone, what stands for most first.
//!
//! Little-endian throughout, no padding:
//!
//! | Part | Bytes | Content |
//! |---|---|---|
//! | head | 44 | `b"CSGB"`, layout version 3, `sh_degree`, `packs: u16`, `splats: u32`, `cameras: u32`, bounds min xyz and max xyz `f32`, CRC-32 of the other 40 and the table |
//! | table | 12 each | kind, layer, `splats: u16`, `bytes: u32`, CRC-32 of the pack: [`PackEntry`] |
//! | packs | `bytes` each | in the table's order |
//!
//! The packs are in this order: the cameras, the basis of the spherical harmonics, then all others. Each pack of shapes
//! has one of spherical harmonics: those of the first layer and those of the other layers are each in the order of their
//! shapes. The first layer may be a *base*: splats as they must be to stand in for all. Then each of its packs has one of
//! changes, in the same order; where that has come, these splats are what they become with it, and there is room for the
//! splats of the packs of shapes before it. A pack is one frame of
//! [zstd](https://datatracker.ietf.org/doc/html/rfc8878), or stored as it is where that would save nothing
//! or too much ([`RATIO_MAX`]). So any part of a body is worth something: every pack that is there can be
//! unpacked once the head and the table are.
//!
//! | Pack | Bytes unpacked | Content |
//! |---|---|---|
//! | cameras | 96 each | [`CameraRecord`] |
//! | shapes | 20 + 20 each | [`ShapeFrame`], then [`Shape`]s in planes of one byte |
//! | changes | 20 each | differences of [`Shape`]s in planes of one byte |
//! | basis | 6 + 4 m + 2 m² | [`basis`]: the directions in which the spherical harmonics of this model vary, m = 3 (sh_degree + 1)² - 3 |
//! | spherical harmonics | [`ShLayout::splat_bytes`] each | whole steps along those directions, in planes |
//!
//! This module turns bytes into whole numbers and checks sizes; what the numbers mean in metres and colours
//! stands with them, who chooses them is not known here.

pub mod basis;
mod bytes;
mod camera;
mod head;
mod plan;
mod sh;
mod shape;

pub use camera::{CAMERA_BYTES, CameraRecord};
pub use head::{
    BodyHead, HEAD_BYTES, PACK_ENTRY_BYTES, PackEntry, PackForm, PackKind, body_bytes_range, plan_bytes,
};
pub use plan::{BodyPlan, Pack, SplatPacks};
pub use sh::ShLayout;
pub use shape::{
    COLOR_STEP, LOG_SCALE_MAX, LOG_SCALE_STEP, OPACITY_STEP, POSITION_MAX, QUAT_ZERO, SHAPE_BYTES,
    SHAPE_FRAME_BYTES, STEP_EXPONENTS, Shape, ShapeFrame, THICKNESS_STEP, read_changes, read_shapes,
    write_changes, write_shapes,
};

use core::fmt;

use serde::{Deserialize, Serialize};

/// Highest degree of spherical harmonics.
pub const MAX_SH_DEGREE: u8 = 3;
/// Most splats of one pack: large enough for zstd's tables to pay, small enough that a slow radio finishes
/// one in half a minute.
pub const PACK_SPLATS_MAX: usize = 8192;
/// A pack unpacks to at most so many times its bytes. Honest models stay below 3; what would exceed this is
/// stored as it is, so that few bytes never ask for much memory.
pub const RATIO_MAX: usize = 8;
/// Logarithm to base 2 of zstd's window: a frame that asks for more memory is refused. Every pack of splats fits.
pub const WINDOW_LOG: u32 = 19;

/// Floats of spherical harmonics per splat beside the colour: `3 (sh_degree + 1)² - 3`.
pub const fn sh_rest(sh_degree: u8) -> usize {
    let n = sh_degree as usize + 1;
    3 * n * n - 3
}

/// An axis-aligned box in the world frame, both corners belonging to it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Bounds {
    /// Least x, y and z, world units.
    pub min: [f32; 3],
    /// Greatest x, y and z, world units.
    pub max: [f32; 3],
}

impl Bounds {
    /// Whether both corners are finite and in order.
    pub fn is_sane(&self) -> bool {
        (0..3).all(|k| self.min[k].is_finite() && self.max[k].is_finite() && self.min[k] <= self.max[k])
    }

    /// Whether a point is inside; NaN never is.
    pub fn contains(&self, point: [f32; 3]) -> bool {
        (0..3).all(|k| point[k] >= self.min[k] && point[k] <= self.max[k])
    }

    /// The point inside that is nearest.
    pub fn clamp(&self, point: [f32; 3]) -> [f32; 3] {
        core::array::from_fn(|k| point[k].clamp(self.min[k], self.max[k]))
    }
}

/// Why bytes are no body.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum BodyError {
    /// Too short for its head and table.
    Truncated,
    /// It does not begin with `CSGB`.
    BadMagic,
    /// A layout this build does not know.
    UnknownLayout(u8),
    /// The degree is above [`MAX_SH_DEGREE`], or the bounds are no box.
    BadHead,
    /// Head and table do not have the checksum that they say.
    Damaged,
    /// An entry of the table contradicts the head, the order of packs or its own sizes.
    BadTable,
    /// The bytes are not as many as the table asks for.
    WrongSize {
        /// What head and table ask for.
        expected: u64,
        /// What is there.
        found: u64,
    },
    /// A pack does not unpack to what it should hold.
    BadPack,
}

impl fmt::Display for BodyError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Truncated => write!(f, "body shorter than its head and table"),
            Self::BadMagic => write!(f, "body does not begin with CSGB"),
            Self::UnknownLayout(found) => {
                write!(f, "body layout {found} is not {}: update the older side", head::LAYOUT)
            }
            Self::BadHead => write!(f, "body head with impossible values"),
            Self::Damaged => write!(f, "body head or table damaged"),
            Self::BadTable => write!(f, "body table that contradicts itself"),
            Self::WrongSize { expected, found } => {
                write!(f, "body of {found} bytes, its table asks for {expected}")
            }
            Self::BadPack => write!(f, "body pack that does not unpack"),
        }
    }
}

impl core::error::Error for BodyError {}
