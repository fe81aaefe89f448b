//! Bytes that each backend takes for a splat, a splat–tile pair and a picture.

use super::capacity::Capacity;
use crate::backend::Channels;
use crate::layout::planes::{PLANES_GEOMETRY, planes};
use crate::layout::rows::{GRADIENT_ROWS, RECORD_LEN, SCORE_ROWS, STAT_ROWS, parameter_rows, sh_rows};
use crate::layout::tiles::{padded_pixels, plane_len};

/// Bytes that a process with a graphics card takes beside all buffers: driver, compiled passes, staging memory.
/// Measured with Mesa's software driver during training.
pub const DRIVER_BYTES: u64 = 256 << 20;

/// Bytes of the record of one splat–tile pair.
const RECORD_BYTES: usize = 4 * RECORD_LEN;

/// Bytes of a projected splat, which both backends store as 16 numbers.
pub(crate) const PROJECTED_BYTES: usize = 64;

/// Number of planes that the surface losses keep on the CPU: depth and luma, of the view and of its neighbouring view.
const SURFACE_PLANES: usize = 4;

/// Numbers that a graphics card stores for each pixel: the partial derivatives of SSIM, three for each colour channel.
pub(crate) const PARTIALS: usize = 9;

/// Numbers that a graphics card stores for each pixel of a teacher's rendering: depth, trust, and the three axes of the
/// normal.
pub(crate) const TAUGHT_NUMBERS: usize = 5;

/// Memory of a backend, bytes.
#[derive(Clone, Copy, Debug)]
pub struct Costs {
    /// Bytes of the driver and what comes with it; 0 on the CPU. See [`DRIVER_BYTES`].
    pub(super) driver: u64,
    /// Bytes of all picture buffers.
    pub pictures: usize,
    /// Bytes per splat.
    pub splat: usize,
    /// Bytes per splat–tile pair.
    pub pair: usize,
    binding: Option<Binding>,
}

/// Bytes that decide whether a graphics card can bind the largest buffers.
#[derive(Clone, Copy, Debug)]
struct Binding {
    /// Bytes of the largest picture buffer.
    pictures: usize,
    /// Bytes per splat in the largest buffer of splats.
    splat: usize,
    /// Bytes per splat–tile pair in the largest buffer of pairs.
    pair: usize,
    /// Bytes of the largest buffer that the card can bind.
    most: u64,
}

impl Costs {
    /// Costs of a backend with the sizes and channels of `capacity`. `binding_bytes_max` is the number of bytes in the
    /// largest buffer that the graphics card can bind, or `None` for the CPU.
    pub fn of(capacity: &Capacity, binding_bytes_max: Option<u64>) -> Self {
        match binding_bytes_max {
            Some(most) => Self::on_gpu(capacity, most),
            None => Self::on_cpu(capacity),
        }
    }

    fn on_cpu(capacity: &Capacity) -> Self {
        let Capacity { size_px, sh_degree, channels, training, .. } = *capacity;
        let parameters = 4 * parameter_rows(sh_degree);
        // Bytes: the projected splat; its depth 4; its visible bit 1; sort keys in two copies 16; slots 8; spans and
        // the list of touched splats about 3 × 16 + 8.
        let drawn = PROJECTED_BYTES + 4 + 1 + 16 + 8 + 56;
        let trained = 2 * parameters + 4 * (GRADIENT_ROWS + STAT_ROWS + SCORE_ROWS);
        let rendered = padded_pixels(size_px) * planes(channels) * 4;
        let surface = 4 * SURFACE_PLANES * plane_len(size_px);
        Self {
            driver: 0,
            // The rendered planes, their gradient, and the planes that the surface losses compare.
            pictures: match (training, channels) {
                (false, _) => rendered,
                (true, Channels::Color) => 2 * rendered,
                (true, Channels::Geometry) => 2 * rendered + surface,
            },
            splat: parameters + drawn + if training { trained } else { 0 },
            // An entry in a tile list and an entry in the table of slots, 4 bytes each.
            pair: 8 + if training { RECORD_BYTES } else { 0 },
            binding: None,
        }
    }

    fn on_gpu(capacity: &Capacity, most: u64) -> Self {
        let Capacity { size_px, sh_degree, channels, training, .. } = *capacity;
        let parameters = 4 * parameter_rows(sh_degree);
        // Bytes: the projected splat; its depth, its place in the list of visible splats and its slots 16; keys and
        // values to sort, in two copies, 16.
        let drawn = PROJECTED_BYTES + 16 + 16;
        let trained = 2 * parameters + 4 * (GRADIENT_ROWS + STAT_ROWS + SCORE_ROWS);
        // Bytes per pixel: depth and luma of two views 16; gradients for four neighbouring depths 16; a sampled pixel
        // 4; the teacher's surface; sums 1.
        let surface = match channels {
            Channels::Color => 0,
            Channels::Geometry => 16 + 16 + 4 + 4 * TAUGHT_NUMBERS + 1,
        };
        // Bytes per pixel: the rendered planes; their gradient; the photograph; the partial derivatives of SSIM; tables
        // of tiles 1; the surface losses.
        let pixel = 4 * (2 * PLANES_GEOMETRY + 3 + PARTIALS) + 1 + surface;
        Self {
            driver: DRIVER_BYTES,
            pictures: padded_pixels(size_px) * pixel,
            splat: parameters + drawn + if training { trained } else { 0 },
            // Bytes: keys and values to sort, in two copies, 16; the pair's splat 4; its share of the sort's counts 1;
            // its record.
            pair: 16 + 4 + 1 + if training { RECORD_BYTES } else { 0 },
            binding: Some(Binding {
                pictures: padded_pixels(size_px) * 4 * PARTIALS.max(PLANES_GEOMETRY),
                splat: (4 * GRADIENT_ROWS.max(sh_rows(sh_degree))).max(PROJECTED_BYTES),
                pair: RECORD_BYTES,
                most,
            }),
        }
    }

    /// Largest number of splats, with `pairs_per_splat` pairs each, whose buffers the graphics card can bind;
    /// `usize::MAX` on the CPU.
    pub fn splats_max(&self, pairs_per_splat: usize) -> usize {
        let Some(Binding { splat, pair, most, .. }) = self.binding else { return usize::MAX };
        (most / splat.max(pairs_per_splat * pair) as u64) as usize
    }

    /// The bytes of the largest picture buffer and of the largest buffer that the graphics card can bind, if the card
    /// cannot bind that picture buffer; otherwise `None`.
    pub(super) fn unbindable_picture(&self) -> Option<(u64, u64)> {
        let Binding { pictures, most, .. } = self.binding?;
        (pictures as u64 > most).then_some((pictures as u64, most))
    }
}
