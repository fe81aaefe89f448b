//! Bytes that each backend takes for a splat, a splat–tile pair and a picture.

use super::capacity::Capacity;
use crate::backend::Channels;
use crate::layout::planes::{PLANES_GEOMETRY, planes};
use crate::layout::rows::{GRADIENT_ROWS, RECORD_LEN, SCORE_ROWS, STAT_ROWS, parameter_rows, sh_rows};
use crate::layout::tiles::{padded_pixels, plane_len};

/// Bytes of the process for a graphics card, beside all buffers: driver, compiled passes, staging memory. Measured with
/// Mesa's software driver during training.
pub const DRIVER_BYTES: u64 = 256 << 20;

/// Bytes of the record of one splat–tile pair.
const RECORD_BYTES: usize = 4 * RECORD_LEN;

/// Bytes of a projected splat, which both backends keep as 16 numbers.
pub(crate) const PROJECTED_BYTES: usize = 64;

/// Planes that the losses of the surface keep on the CPU: depth and luma, of the view and of its neighbour.
const SURFACE_PLANES: usize = 4;

/// Numbers for each pixel on a graphics card: the partial derivatives of SSIM, three for each channel.
pub(crate) const PARTIALS: usize = 9;

/// Numbers for each pixel on a graphics card: the teacher's depth, trust and normal.
pub(crate) const TAUGHT_NUMBERS: usize = 5;

/// Memory of a backend, bytes.
#[derive(Clone, Copy, Debug)]
pub struct Costs {
    /// Bytes of the driver.
    pub(super) driver: u64,
    /// Bytes of the pictures.
    pub pictures: usize,
    /// Bytes of a splat.
    pub splat: usize,
    /// Bytes of a splat–tile pair.
    pub pair: usize,
    binding: Option<Binding>,
}

/// Bytes in the largest buffers of a graphics card.
#[derive(Clone, Copy, Debug)]
struct Binding {
    /// Bytes of the largest buffer of pictures.
    pictures: usize,
    /// Bytes of a splat and of a pair in the largest buffer of each.
    splat: usize,
    pair: usize,
    /// Bytes of the largest buffer that the card can bind.
    most: u64,
}

impl Costs {
    /// Costs of a backend with the pictures, SH degree and channels of `capacity`: of the CPU, or of a
    /// graphics card that can bind buffers of up to `binding_bytes_max`.
    pub fn of(capacity: &Capacity, binding_bytes_max: Option<u64>) -> Self {
        match binding_bytes_max {
            Some(most) => Self::on_gpu(capacity, most),
            None => Self::on_cpu(capacity),
        }
    }

    fn on_cpu(capacity: &Capacity) -> Self {
        let Capacity { size_px, sh_degree, channels, training, .. } = *capacity;
        let parameters = 4 * parameter_rows(sh_degree);
        // Depth 4 + visible bit, sort keys 16, slots 8, spans and touched lists about 3 × 16 + 8.
        let drawn = PROJECTED_BYTES + 4 + 1 + 16 + 8 + 56;
        let trained = 2 * parameters + 4 * (GRADIENT_ROWS + STAT_ROWS + SCORE_ROWS);
        let rendered = padded_pixels(size_px) * planes(channels) * 4;
        let surface = 4 * SURFACE_PLANES * plane_len(size_px);
        Self {
            driver: 0,
            // The rendered planes, their gradient, and what the losses of the surface compare.
            pictures: match (training, channels) {
                (false, _) => rendered,
                (true, Channels::Color) => 2 * rendered,
                (true, Channels::Geometry) => 2 * rendered + surface,
            },
            splat: parameters + drawn + if training { trained } else { 0 },
            // List and slot entries 8.
            pair: 8 + if training { RECORD_BYTES } else { 0 },
            binding: None,
        }
    }

    fn on_gpu(capacity: &Capacity, most: u64) -> Self {
        let Capacity { size_px, sh_degree, channels, training, .. } = *capacity;
        let parameters = 4 * parameter_rows(sh_degree);
        // Depth, place and slots 16, keys and values to sort twice 16.
        let drawn = PROJECTED_BYTES + 16 + 16;
        let trained = 2 * parameters + 4 * (GRADIENT_ROWS + STAT_ROWS + SCORE_ROWS);
        // Four planes, gradients for the neighbours, a sample, the teacher's surface, sums.
        let surface = match channels {
            Channels::Color => 0,
            Channels::Geometry => 16 + 16 + 4 + 4 * TAUGHT_NUMBERS + 1,
        };
        // Rendered planes, their gradient, the photograph, SSIM's derivatives, tiles.
        let pixel = 4 * (2 * PLANES_GEOMETRY + 3 + PARTIALS) + 1 + surface;
        Self {
            driver: DRIVER_BYTES,
            pictures: padded_pixels(size_px) * pixel,
            splat: parameters + drawn + if training { trained } else { 0 },
            // Keys and values twice, the pair's splat, its share of the sort's counts.
            pair: 16 + 4 + 1 + if training { RECORD_BYTES } else { 0 },
            binding: Some(Binding {
                pictures: padded_pixels(size_px) * 4 * PARTIALS.max(PLANES_GEOMETRY),
                splat: (4 * GRADIENT_ROWS.max(sh_rows(sh_degree))).max(PROJECTED_BYTES),
                pair: RECORD_BYTES,
                most,
            }),
        }
    }

    /// Largest number of splats, with `pairs_per_splat` pairs each, whose buffers the graphics card can bind.
    pub fn splats_max(&self, pairs_per_splat: usize) -> usize {
        let Some(Binding { splat, pair, most, .. }) = self.binding else { return usize::MAX };
        (most / splat.max(pairs_per_splat * pair) as u64) as usize
    }

    /// Bytes of the largest buffer of pictures, and the most bytes that the graphics card can bind; `None` if
    /// the latter suffices.
    pub(super) fn unbindable_picture(&self) -> Option<(u64, u64)> {
        let Binding { pictures, most, .. } = self.binding?;
        (pictures as u64 > most).then_some((pictures as u64, most))
    }
}
