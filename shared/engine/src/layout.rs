//! What both backends agree on: camera parameters, the layout of tiles and planes, the order of a splat's numbers, the
//! pixels that are sampled, and the constants of the method. Nothing here belongs to a device, so `cpu` and `gpu` can
//! both depend on it and never on each other.

pub(crate) mod constants;
pub(crate) mod harmonics;
pub(crate) mod planes;
pub(crate) mod rendering;
pub(crate) mod rows;
pub(crate) mod sampling;
pub(crate) mod tiles;
pub(crate) mod view;
