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
mod bounds;
mod bytes;
mod camera;
mod error;
mod head;
mod limits;
mod plan;
mod sh;
mod shape;

pub use bounds::Bounds;
pub use camera::{CAMERA_BYTES, CameraRecord};
pub use error::BodyError;
pub use head::{
    BodyHead, HEAD_BYTES, PACK_ENTRY_BYTES, PackEntry, PackForm, PackKind, body_bytes_range, plan_bytes,
};
pub use limits::{MAX_SH_DEGREE, PACK_SPLATS_MAX, RATIO_MAX, WINDOW_LOG, sh_rest};
pub use plan::{BodyPlan, Pack, SplatPacks};
pub use sh::ShLayout;
pub use shape::{
    COLOR_STEP, LOG_SCALE_MAX, LOG_SCALE_STEP, OPACITY_STEP, POSITION_MAX, QUAT_ZERO, SHAPE_BYTES,
    SHAPE_FRAME_BYTES, STEP_EXPONENTS, Shape, ShapeFrame, THICKNESS_STEP, read_changes, read_shapes,
    write_changes, write_shapes,
};
