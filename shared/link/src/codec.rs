//! Encodes models as bodies, and decodes bodies: quantises and dequantises the values that
//! [`cosurf_wire::body`] lays out. Equal models give equal bytes.
//!
//! The encoder aims at no more than 16 bytes per splat at degrees 1 and 2 of the spherical harmonics, and 18
//! bytes at degree 3. The results document has the quality. These methods save bytes:
//!
//! - Splats are grouped into layers by importance. Within a layer, neighbours along a Morton curve share a
//!   pack ([`order`]), so that the differences between consecutive positions are small.
//! - Instead of these layers, a *base* can come first: fewer splats, trained to stand in for the whole model
//!   ([`cosurf_scene::Base`]). The other splats follow, region by region. Each region also contains the
//!   changes that turn the region's base splats into their final form.
//! - The quantisation step of positions follows from the size of the pack's splats, so that the error is
//!   invisible.
//! - The axes of a splat are sorted by length, so the third axis is the normal. Of the equivalent
//!   quaternions, the one with the largest w is chosen, so that w need not be stored ([`shapes`]). The
//!   shortest axis is stored relative to the middle one, because most splats are flat.
//! - View-dependent spherical harmonics are stored as coordinates along their principal directions in this
//!   model ([`basis`]). Most of these coordinates need at most one bit per splat. The quantisation step is
//!   chosen so that the body meets its target size.
//! - A pack is stored in byte planes: the first byte of every splat, then the second byte of every splat, and
//!   so on. Each plane is a zstd block of its own, so that it is coded by its own statistics ([`pack`]).

#![cfg_attr(not(test), warn(clippy::disallowed_methods))]

mod basis;
mod decode;
mod encode;
mod harmonics;
mod layers;
mod order;
mod pack;
mod packs;
mod shapes;
#[cfg(test)]
mod tests;

pub(crate) use decode::{body_cameras, checked_part_to_model};
pub use decode::{body_frame, body_to_model, check_body, part_to_model, scene_frame};
pub use encode::{FirstLayer, model_to_body};
pub use order::plain_importance;
