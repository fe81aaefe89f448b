//! The byte layout of a model: its splats and the cameras of its pictures, never the pictures. The values
//! are quantised to integers, in independently decodable *packs*, most important first.
//!
//! All numbers are little-endian, without padding:
//!
//! | Part | Bytes | Content |
//! |---|---|---|
//! | head | 44 | `b"CSGB"`, layout version 3, `sh_degree`, `packs: u16`, `splats: u32`, `cameras: u32`, bounds min xyz and max xyz `f32`, CRC-32 of these 40 bytes and the table |
//! | table | 12 each | kind, layer, `splats: u16`, `bytes: u32`, CRC-32 of the pack; see [`PackEntry`] |
//! | packs | `bytes` each | in the order of the table |
//!
//! The cameras come first, then the basis of the spherical harmonics, then all other packs. Each shapes pack
//! has one pack of spherical harmonics; within the first layer, and within the other layers, these are in the
//! order of their shapes packs.
//!
//! The first layer may be a *base*: splats changed so that they stand in for the whole model until the rest
//! has arrived. Each base pack then has one changes pack, in the same order. A changes pack turns its base
//! splats into their final form. It comes after the shapes packs of its region, which are shown only together
//! with it.
//!
//! A pack is one [zstd](https://datatracker.ietf.org/doc/html/rfc8878) frame. It is stored uncompressed if
//! zstd would save nothing or too much ([`RATIO_MAX`]). An incomplete body is usable: with the head and the
//! table, every pack that has arrived can be unpacked.
//!
//! | Pack | Bytes unpacked | Content |
//! |---|---|---|
//! | cameras | 96 each | [`CameraRecord`] |
//! | shapes | 20 + 20 each | [`ShapeFrame`], then [`Shape`]s in planes of one byte per splat |
//! | changes | 20 each | differences between [`Shape`]s, in the same planes |
//! | basis | 6 + 4 m + 2 m² | [`basis`]: the principal directions of the model's spherical harmonics, m = 3 (sh_degree + 1)² - 3 |
//! | spherical harmonics | [`ShLayout::splat_bytes`] each | integer steps along these directions, in planes |
//!
//! This module converts between bytes and integers, and checks sizes. The constants here define the metres
//! and colours that the integers stand for; `cosurf-link` quantises and dequantises the values.

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

/// Highest degree of the spherical harmonics.
pub const MAX_SH_DEGREE: u8 = 3;
/// Maximum number of splats in a pack: enough for zstd to compress well, and few enough that a slow radio
/// sends the pack in half a minute.
pub const PACK_SPLATS_MAX: usize = 8192;
/// Maximum compression ratio of a pack; a pack that would exceed it is stored uncompressed. This bounds the
/// memory that a small message can request. Trained models stay far below it.
pub const RATIO_MAX: usize = 8;
/// Base-2 logarithm of the zstd window. A frame that needs a larger window is rejected. Every pack of splats
/// fits into it.
pub const WINDOW_LOG: u32 = 19;

/// View-dependent spherical-harmonics coefficients per splat: `3 (sh_degree + 1)² - 3`.
pub const fn sh_rest(sh_degree: u8) -> usize {
    let n = sh_degree as usize + 1;
    3 * n * n - 3
}

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

    /// Whether a point is inside; `false` for NaN.
    pub fn contains(&self, point: [f32; 3]) -> bool {
        (0..3).all(|k| point[k] >= self.min[k] && point[k] <= self.max[k])
    }

    /// The nearest point inside the box.
    pub fn clamp(&self, point: [f32; 3]) -> [f32; 3] {
        core::array::from_fn(|k| point[k].clamp(self.min[k], self.max[k]))
    }
}

/// Why bytes are not a valid body.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum BodyError {
    /// The body is shorter than its head and table.
    Truncated,
    /// The body does not begin with `CSGB`.
    BadMagic,
    /// This build does not know the body's layout.
    UnknownLayout(u8),
    /// The degree is above [`MAX_SH_DEGREE`], or the bounds are invalid.
    BadHead,
    /// The checksum of head and table does not match.
    Damaged,
    /// A table entry contradicts the head, the order of packs or its own sizes.
    BadTable,
    /// The body does not have the size that the table requires.
    WrongSize {
        /// Size that head and table require, in bytes.
        expected: u64,
        /// Actual size in bytes.
        found: u64,
    },
    /// A pack cannot be unpacked, or holds invalid values.
    BadPack,
}

impl fmt::Display for BodyError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Truncated => write!(f, "body is shorter than its head and table"),
            Self::BadMagic => write!(f, "body does not begin with CSGB"),
            Self::UnknownLayout(found) => {
                write!(f, "body layout {found} is not {}: update the older side", head::LAYOUT)
            }
            Self::BadHead => write!(f, "body head has invalid values"),
            Self::Damaged => write!(f, "body head or table is damaged"),
            Self::BadTable => write!(f, "body table contradicts itself"),
            Self::WrongSize { expected, found } => {
                write!(f, "body has {found} bytes, but its table requires {expected}")
            }
            Self::BadPack => write!(f, "body pack cannot be unpacked"),
        }
    }
}

impl core::error::Error for BodyError {}
