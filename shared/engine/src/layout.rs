//! Code that the CPU and the GPU backend share: camera parameters, the layout of tiles and planes of a picture, the
//! order of a splat's numbers, the choice of sampled pixels, and the constants of rendering and losses. Nothing here
//! runs on a particular device, so `cpu` and `gpu` both depend on this module, and never on each other.

pub(crate) mod constants;
pub(crate) mod harmonics;
pub(crate) mod planes;
pub(crate) mod rendering;
pub(crate) mod rows;
pub(crate) mod sampling;
pub(crate) mod tiles;
pub(crate) mod view;
