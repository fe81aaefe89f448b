//! Sizes of a backend's buffers.

use cosurf_scene::{Camera, Splats};

use crate::backend::Channels;

/// Splat–tile pairs that there is room for, per splat. Aerial scenes need 2 to 4 per splat in the whole
/// model; a view that needs more loses its farthest splats, and the report says so. A renderer grows instead.
pub const PAIRS_PER_SPLAT: usize = 4;

/// The same where every camera shows most of the model, as in distillation and scoring.
pub const PAIRS_PER_SEEN_SPLAT: usize = PAIRS_PER_SPLAT + 1;

/// Sizes of a backend's buffers, decided before anything is allocated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Capacity {
    /// Most splats.
    pub splats: usize,
    /// Most splat–tile pairs of one view.
    pub pairs: usize,
    /// Largest picture.
    pub size_px: [u32; 2],
    /// Stored SH degree, 0..=3.
    pub sh_degree: u32,
    /// Channels that will be asked for.
    pub channels: Channels,
    /// Whether the optimiser's buffers are wanted; false for rendering only.
    pub training: bool,
}

impl Capacity {
    /// Room to train or to score `splats` under `cameras`.
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

    /// Room to render models of an SH degree on the CPU; splats and pairs are not counted yet.
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
