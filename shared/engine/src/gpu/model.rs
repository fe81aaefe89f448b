//! The splats on the GPU. Each parameter has one row of numbers, so that neighbouring invocations read neighbouring
//! numbers. Shapes and colours are in separate buffers, because adapters limit the size of a buffer.

use cosurf_scene::Splats;

use super::buffer::Buffer;
use super::context::{Gpu, GpuError};
use crate::layout::rows::{LOG_SCALE, OPACITY, QUAT, SH, sh_rows};

/// The splats of a model.
#[derive(Debug)]
pub(super) struct Model {
    /// Means, quaternions, log scales and opacity logits. Row `r` of splat `i` is at `r * stride + i`, here and in
    /// `sh`.
    pub(super) shape: Buffer<f32>,
    pub(super) sh: Buffer<f32>,
    /// Capacity for splats: the distance between rows.
    pub(super) stride: usize,
    pub(super) len: usize,
    pub(super) sh_degree: u32,
}

impl Model {
    /// An empty model with room for `capacity` splats.
    pub(super) fn new(gpu: &Gpu, capacity: usize, sh_degree: u32) -> Result<Self, GpuError> {
        let stride = capacity.max(1);
        Ok(Self {
            shape: Buffer::storage(gpu, "shapes", SH * stride)?,
            sh: Buffer::storage(gpu, "spherical harmonics", sh_rows(sh_degree) * stride)?,
            stride,
            len: 0,
            sh_degree,
        })
    }

    /// Replaces all splats. The SH degree of the model stays: missing coefficients become zero, additional ones are
    /// dropped.
    pub(super) fn load(&mut self, gpu: &Gpu, splats: &Splats) {
        self.len = splats.len();
        let mut row = vec![0.0; self.len];
        for r in 0..SH {
            for (i, value) in row.iter_mut().enumerate() {
                *value = match r {
                    0..QUAT => splats.means[i][r],
                    QUAT..LOG_SCALE => splats.quats[i][r - QUAT],
                    LOG_SCALE..OPACITY => splats.log_scales[i][r - LOG_SCALE],
                    _ => splats.opacity_logits[i],
                };
            }
            self.shape.write(gpu, r * self.stride, &row);
        }
        for r in 0..sh_rows(self.sh_degree) {
            for (i, value) in row.iter_mut().enumerate() {
                *value = splats.sh_of(i).get(r).copied().unwrap_or(0.0);
            }
            self.sh.write(gpu, r * self.stride, &row);
        }
    }

    /// The splats as they are now.
    pub(super) fn splats(&self, gpu: &Gpu) -> Splats {
        let row = |buffer: &Buffer<f32>, r: usize| {
            buffer.read(gpu, r * self.stride..r * self.stride + self.len).into_iter().enumerate()
        };
        let mut splats = Splats::with_capacity(self.len, self.sh_degree);
        let blank = vec![0.0; splats.sh_stride()];
        (0..self.len).for_each(|_| splats.push([0.0; 3], [0.0; 4], [0.0; 3], 0.0, &blank));
        for r in 0..SH {
            row(&self.shape, r).for_each(|(i, value)| match r {
                0..QUAT => splats.means[i][r] = value,
                QUAT..LOG_SCALE => splats.quats[i][r - QUAT] = value,
                LOG_SCALE..OPACITY => splats.log_scales[i][r - LOG_SCALE] = value,
                _ => splats.opacity_logits[i] = value,
            });
        }
        let stride = splats.sh_stride();
        for r in 0..stride {
            row(&self.sh, r).for_each(|(i, value)| splats.sh[i * stride + r] = value);
        }
        splats
    }
}
