//! Sizes of a backend's buffers.

use cosurf_scene::{Camera, Splats};

use crate::backend::Channels;

/// Capacity for the splat–tile pairs of one view, per splat of the whole model. Aerial scenes need 2 to 4. If a
/// training view needs more, its farthest splats are not blended, and the report says so. A
/// [`Renderer`](crate::Renderer) grows its buffers instead.
pub const PAIRS_PER_SPLAT: usize = 4;

/// Capacity for the splat–tile pairs of one view, per splat of the model, if each camera sees most of the model. This
/// is so in distillation and scoring.
pub const PAIRS_PER_SEEN_SPLAT: usize = PAIRS_PER_SPLAT + 1;

/// Sizes of a backend's buffers, decided before anything is allocated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Capacity {
    /// Largest number of splats.
    pub splats: usize,
    /// Largest number of splat–tile pairs in one view.
    pub pairs: usize,
    /// Width and height of the largest picture, px.
    pub size_px: [u32; 2],
    /// Stored SH degree, 0..=3.
    pub sh_degree: u32,
    /// Channels that will be blended.
    pub channels: Channels,
    /// True to train; false to render only, without the buffers of the optimiser.
    pub training: bool,
}

impl Capacity {
    /// Capacity to train or to score `splats` with the pictures of `cameras`.
    pub fn to_train(splats: &Splats, cameras: &[Camera], channels: Channels) -> Self {
        Self {
            splats: splats.len(),
            pairs: PAIRS_PER_SEEN_SPLAT * splats.len(),
            size_px: [0, 1].map(|axis| cameras.iter().map(|camera| camera.size_px[axis]).max().unwrap_or(1)),
            sh_degree: splats.sh_degree,
            channels,
            training: true,
        }
    }

    /// Capacity to render models of this SH degree, with no splats, no pairs and pictures of 1 × 1 px. Callers replace
    /// the sizes that they know. The picture buffers of a [`CpuBackend`](crate::CpuBackend) grow if pictures are
    /// larger.
    pub fn to_render(sh_degree: u32) -> Self {
        Self {
            splats: 0,
            pairs: 0,
            size_px: [1, 1],
            sh_degree,
            channels: Channels::Geometry,
            training: false,
        }
    }
}
