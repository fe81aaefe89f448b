//! A picture with one number per pixel, stored row by row, with margins of zeros. Because of the margins, SIMD loads
//! may reach beyond the edges of the picture.

use rayon::prelude::*;

use crate::backend::TargetRgb;
use crate::layout::constants::{LUMA_WEIGHTS, MASKED_LUMA};
use crate::layout::tiles::{PLANE_MARGIN as MARGIN, plane_len, plane_stride};
use crate::simd::Lanes;

/// A picture with one number per pixel and margins of zeros.
#[derive(Debug, Default)]
pub(super) struct Plane {
    size_px: [usize; 2],
    stride: usize,
    data: Vec<f32>,
}

impl Plane {
    /// Length of a line with its margins, for pictures up to `size_px`.
    pub(super) fn stride_for(size_px: [u32; 2]) -> usize {
        plane_stride(size_px[0] as usize)
    }

    pub(super) fn with_capacity(size_px: [u32; 2]) -> Self {
        Self { data: Vec::with_capacity(plane_len(size_px)), ..Self::default() }
    }

    /// Sets the size of the picture. All numbers become zero.
    pub(super) fn reshape(&mut self, size_px: [usize; 2]) {
        self.size_px = size_px;
        self.stride = plane_stride(size_px[0]);
        self.data.clear();
        self.data.resize(self.stride * (size_px[1] + 2), 0.0);
    }

    /// The line of picture row `y`, which may be -1..=height. Column `x` is at [`Plane::at`]`(x)`.
    #[inline(always)]
    pub(super) fn line(&self, y: isize) -> &[f32] {
        &self.data[(y + 1) as usize * self.stride..][..self.stride]
    }

    /// Index of column `x` in a line. Columns up to 16 px outside the picture are allowed.
    #[inline(always)]
    pub(super) fn at(x: isize) -> usize {
        (x + MARGIN as isize) as usize
    }

    pub(super) fn size_px(&self) -> [usize; 2] {
        self.size_px
    }

    /// Length of a line with its margins.
    pub(super) fn stride(&self) -> usize {
        self.stride
    }

    /// The lines of the picture with their margins.
    pub(super) fn lines_mut(&mut self) -> impl IndexedParallelIterator<Item = &mut [f32]> {
        let (stride, height) = (self.stride, self.size_px[1]);
        self.data[stride..].par_chunks_exact_mut(stride).take(height)
    }

    #[inline(always)]
    pub(super) fn value(&self, x: usize, y: usize) -> f32 {
        self.data[(y + 1) * self.stride + MARGIN + x]
    }

    /// Interpolates bilinearly between the four pixel centres around `q_px`, and computes the slopes. `None` if one of
    /// the four is outside the picture.
    #[inline(always)]
    pub(super) fn sample<L: Lanes>(&self, q_px: [f32; 2]) -> Option<Sample> {
        let (u, v) = (q_px[0] - 0.5, q_px[1] - 0.5);
        // A comparison with NaN is false, so NaN is outside.
        if !(u >= 0.0 && v >= 0.0 && u < (self.size_px[0] - 1) as f32 && v < (self.size_px[1] - 1) as f32) {
            return None;
        }
        let (x, y) = (u as usize, v as usize);
        let (a, b) = (u - x as f32, v - y as f32);
        let start = (y + 1) * self.stride + MARGIN + x;
        let (upper, lower) = (&self.data[start..start + 2], &self.data[start + self.stride..][..2]);
        let (top, bottom) = (upper[1] - upper[0], lower[1] - lower[0]);
        let (left, right) = (lower[0] - upper[0], lower[1] - upper[1]);
        let value = L::fused(a, top, upper[0]) + b * (left + a * (right - left));
        let least = upper[0].min(upper[1]).min(lower[0]).min(lower[1]);
        Some(Sample { value, slope: [top + b * (bottom - top), left + a * (right - left)], least })
    }
}

/// Result of [`Plane::sample`].
#[derive(Clone, Copy)]
pub(super) struct Sample {
    pub(super) value: f32,
    /// ∂value/∂x and ∂value/∂y, per px.
    pub(super) slope: [f32; 2],
    /// The smallest of the four values that were interpolated.
    pub(super) least: f32,
}

/// Writes the luma of a picture; [`MASKED_LUMA`] where it is masked.
pub(super) fn luma(rgb: TargetRgb, size_px: [u32; 2], plane: &mut Plane) {
    let size = size_px.map(|side| side as usize);
    plane.reshape(size);
    plane.lines_mut().enumerate().for_each(|(y, line)| {
        rgb.luma_line(y, size[0], &mut line[MARGIN..MARGIN + size[0]]);
        rgb.masked_in(y, size[0]).for_each(|x| line[MARGIN + x] = MASKED_LUMA);
    });
}

impl TargetRgb<'_> {
    /// Writes the luma (Rec. 601) of picture row `y` to `line`. Bytes are scaled to 0..=1.
    fn luma_line(&self, y: usize, width: usize, line: &mut [f32]) {
        let range = 3 * y * width..3 * (y + 1) * width;
        match self {
            Self::Bytes(rgb) => {
                let weights = LUMA_WEIGHTS.map(|w| w / 255.0);
                for (value, pixel) in line.iter_mut().zip(rgb[range].chunks_exact(3)) {
                    *value = (0..3).map(|c| weights[c] * f32::from(pixel[c])).sum();
                }
            }
            Self::Floats(rgb) => {
                for (value, pixel) in line.iter_mut().zip(rgb[range].chunks_exact(3)) {
                    *value = (0..3).map(|c| LUMA_WEIGHTS[c] * pixel[c]).sum();
                }
            }
        }
    }
}
