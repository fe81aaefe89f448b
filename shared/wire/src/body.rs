//! The byte layout of a model (a *body*): its splats and the cameras of its pictures, never the pictures.
//! The values are quantised to integers. The integers are grouped in *packs*. Each pack can be unpacked on
//! its own, and the most important packs come first.
//!
//! All numbers are little-endian, without padding:
//!
//! | Part | Bytes | Content |
//! |---|---|---|
//! | head | 44 | [`BodyHead`], in the fields below |
//! | table | 12 each | one [`PackEntry`] for each pack: kind, layer, `splats: u16`, `bytes: u32`, CRC-32 |
//! | packs | `bytes` each | in the order of the table |
//!
//! The fields of the head are `b"CSGB"`, the layout version 3 (`u8`), `sh_degree: u8`, `packs: u16`,
//! `splats: u32`, `cameras: u32`, and the bounds (min xyz and max xyz, `f32`). The CRC-32 of these 40 bytes
//! and of the table ends the head.
//!
//! The splats are divided into *layers* of falling importance, and each layer into groups. Each group has
//! one shapes pack and, if `sh_degree` is above 0, one pack of spherical harmonics.
//!
//! A body of a scene far from the world's origin begins with a pack for its origin: positions of splats and the bounds
//! are relative to it. Without the pack, the origin is zero. Cameras are in world coordinates.
//!
//! The origin and the cameras come first, then the basis of the spherical harmonics, then all other packs. The packs of
//! spherical harmonics of the first layer have the same order as the shapes packs of that layer. The same
//! holds for the packs of all other layers, taken together.
//!
//! The first layer may be a *base*: splats that are trained to stand in for the whole model until the rest
//! has arrived. Each shapes pack of the base then has one changes pack, in the same order, which turns its
//! base splats into their final form. Space is divided into regions, one for each base pack. The shapes
//! packs of the other layers follow region by region. After the shapes packs of a region comes the changes
//! pack of its base splats. Until this changes pack has arrived, the base stands in for the region, and the
//! other splats of the region must not be shown.
//!
//! A pack is one [zstd](https://datatracker.ietf.org/doc/html/rfc8878) frame, or its uncompressed bytes if
//! zstd would not make it smaller or would exceed the largest accepted ratio ([`RATIO_MAX`]). An incomplete
//! body is usable: packs that have arrived after the head and the table can be unpacked.
//!
//! | Pack | Bytes unpacked | Content |
//! |---|---|---|
//! | origin | 24 | xyz as `f64`, world units, see [`decode_origin`] |
//! | cameras | 96 each | [`CameraRecord`] |
//! | shapes | 20 + 20 each | [`ShapeFrame`], then [`Shape`]s in planes of one byte per splat |
//! | changes | 20 each | differences between [`Shape`]s, in planes as above |
//! | basis | 6 + 4 m + 2 m² | [`basis`] of the spherical harmonics, m = 3 (sh_degree + 1)² - 3 |
//! | spherical harmonics | [`ShLayout::splat_bytes`] each | steps along the directions of the basis, in planes |
//!
//! This module converts between bytes and integers, and checks sizes. Its constants, such as
//! [`COLOR_STEP`], define which lengths and colours the integers stand for. The crate `cosurf-link`
//! quantises and dequantises the values.

pub mod basis;
mod bounds;
mod bytes;
mod camera;
mod error;
mod head;
mod limits;
mod origin;
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
pub use origin::{ORIGIN_BYTES, ORIGIN_MAX, decode_origin, encode_origin};
pub use plan::{BodyPlan, Pack, SplatPacks};
pub use sh::ShLayout;
pub use shape::{
    COLOR_STEP, LOG_SCALE_MAX, LOG_SCALE_STEP, OPACITY_STEP, POSITION_MAX, QUAT_ZERO, SHAPE_BYTES,
    SHAPE_FRAME_BYTES, STEP_EXPONENTS, Shape, ShapeFrame, THICKNESS_STEP, read_changes, read_shapes,
    write_changes, write_shapes,
};
