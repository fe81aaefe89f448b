//! Models to bodies and back: what [`cosurf_wire::body`] lays out, in metres and colours.
//!
//! What it costs and what it keeps, on trained models, is in the README: below 16 bytes a splat with
//! spherical harmonics of degree 2, 18 with degree 3, where 32-bit floats take 152 and 236. What makes the
//! difference:
//!
//! - Splats are grouped into layers by importance, and within a layer along a Morton curve into packs of
//!   neighbours ([`order`]), so that positions are short ways from the splat before.
//! - Or a *base* goes first, splats that were taught to stand in for all ([`cosurf_scene::Base`]): a third of the
//!   splats in a fifth of the bytes. The others follow region by region, and with each region what the base becomes
//!   there.
//! - A position's step follows the size of the pack's splats: nobody sees a thirtieth of one.
//! - The axes of a splat are put in order of length, the third being its normal, and of the quaternions that
//!   then mean the same the one with the largest w is taken, which need not be sent ([`shapes`]). The least
//!   axis is told in parts of the middle one, for most splats are flat.
//! - Spherical harmonics are told along the directions in which they vary in this model ([`basis`]), most of
//!   which need a bit or less; the step follows from the bytes that are left.
//! - Each plane of bytes ends its block of zstd, so it is coded by its own statistics ([`pack`]).
//!
//! The same model gives the same bytes.

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

pub(crate) use decode::announced_part;
pub use decode::{body_to_model, check_body, part_to_model};
pub use encode::{First, model_to_body};
pub use order::plain_importance;
