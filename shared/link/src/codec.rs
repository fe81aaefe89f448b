//! Encodes models as bodies and decodes bodies: it quantises and dequantises the values that
//! [`cosurf_wire::body`] lays out. Equal models give equal bytes.
//!
//! A splat takes at most 16 bytes with spherical harmonics of degree 2, and 18 with degree 3; the results
//! document has the quality. These methods save bytes:
//!
//! - Splats are grouped into layers by importance. Within a layer, a Morton curve groups neighbours into
//!   packs ([`order`]), so that the differences between consecutive positions are small.
//! - Alternatively a *base* comes first: fewer splats, trained to stand in for the whole model
//!   ([`cosurf_scene::Base`]). The other splats follow region by region. With each region come the changes
//!   that turn its base splats into their final form.
//! - The step of positions follows the size of the pack's splats, so the error is invisible.
//! - The axes of a splat are sorted by length, so the third is its normal. Of the equivalent quaternions, the
//!   one with the largest w is chosen, so w need not be stored ([`shapes`]). The shortest axis is stored
//!   relative to the middle one, since most splats are flat.
//! - Spherical harmonics are stored along their principal directions in this model ([`basis`]), most of which
//!   need at most one bit. Their step follows from the remaining bytes.
//! - Each plane of bytes is a zstd block of its own, so it is coded by its own statistics ([`pack`]).

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

pub(crate) use decode::checked_part_to_model;
pub use decode::{body_to_model, check_body, part_to_model};
pub use encode::{FirstLayer, model_to_body};
pub use order::plain_importance;
