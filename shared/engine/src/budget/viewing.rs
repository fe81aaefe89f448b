//! Bytes that rendering a finished model takes on the CPU.

use cosurf_scene::Splats;

use super::PROCESS_BYTES;
use super::capacity::{Capacity, PAIRS_PER_SPLAT};
use super::costs::Costs;

/// Bytes per pixel of a [`Rendering`](crate::Rendering): colour, alpha, depth and normal.
const RENDERING_BYTES_PER_PIXEL: u64 = 32;

/// A model and pictures of it, whose need of memory is asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Viewing {
    /// Number of splats.
    pub(crate) splats: usize,
    /// SH degree, 0..=3.
    pub(crate) sh_degree: u32,
    /// Width and height of the largest picture, px.
    pub(crate) size_px: [u32; 2],
}

impl Viewing {
    /// Bytes of a process that reads the model and renders the pictures one after the other, if none has more than `pairs`
    /// splat–tile pairs.
    pub(crate) fn bytes(&self, pairs: usize) -> u64 {
        let Self { splats, sh_degree, size_px } = *self;
        let costs = Costs::of(&Capacity { size_px, ..Capacity::to_render(sh_degree) }, None);
        let pixels = u64::from(size_px[0]) * u64::from(size_px[1]);
        // First both the caller and the renderer hold the splats. The buffers for pictures are used later.
        let loading = splats * 2 * Splats::bytes_per_splat(sh_degree);
        let drawing = splats * costs.splat + pairs * costs.pair + costs.pictures;
        PROCESS_BYTES + (loading as u64).max(drawing as u64 + pixels * RENDERING_BYTES_PER_PIXEL)
    }

    /// Number of splat–tile pairs that pictures seldom exceed.
    pub(crate) fn usual_pairs(&self) -> usize {
        PAIRS_PER_SPLAT * self.splats
    }
}
