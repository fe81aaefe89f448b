//! Tables of splats, in blocks of 16 splats with one [`Row`] for each number. So a pass loads one parameter of several
//! splats with one instruction, and can skip blocks that the camera does not see.
//!
//! A block is one contiguous piece of memory to prefetch. With one array for each number, there would be 59 pieces (at
//! SH degree 3).

use cosurf_scene::Splats;

use crate::layout::rows::{LOG_SCALE, MEAN, OPACITY, QUAT, SH};
use crate::simd::{GROUP, Row};

/// `len` splats with `stride` numbers each, in blocks of 16.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Blocks {
    len: usize,
    stride: usize,
    rows: Vec<Row>,
}

impl Blocks {
    /// An empty table with room for `capacity` splats.
    pub(crate) fn with_capacity(capacity: usize, stride: usize) -> Self {
        Self { len: 0, stride, rows: Vec::with_capacity(capacity.div_ceil(GROUP) * stride) }
    }

    pub(crate) fn len(&self) -> usize {
        self.len
    }

    pub(crate) fn stride(&self) -> usize {
        self.stride
    }

    /// Changes the number of splats, within the capacity. New blocks are zero. In a block that is kept, a splat that is
    /// removed and added again has its old values.
    pub(crate) fn resize(&mut self, len: usize) {
        self.rows.resize(len.div_ceil(GROUP) * self.stride, Row::ZERO);
        self.len = len;
    }

    pub(crate) fn fill_zero(&mut self) {
        self.rows.fill(Row::ZERO);
    }

    pub(crate) fn block(&self, block: usize) -> &[Row] {
        &self.rows[block * self.stride..(block + 1) * self.stride]
    }

    pub(crate) fn rows(&self) -> &[Row] {
        &self.rows
    }

    pub(crate) fn rows_mut(&mut self) -> &mut [Row] {
        &mut self.rows
    }

    /// Number `row` of splat `i`.
    pub(crate) fn value(&self, i: usize, row: usize) -> f32 {
        self.rows[i / GROUP * self.stride + row].0[i % GROUP]
    }

    pub(crate) fn set_value(&mut self, i: usize, row: usize, value: f32) {
        self.rows[i / GROUP * self.stride + row].0[i % GROUP] = value;
    }

    /// Copies all numbers of splat `from` to splat `to`.
    pub(crate) fn copy(&mut self, from: usize, to: usize) {
        if from != to {
            for row in 0..self.stride {
                let value = self.value(from, row);
                self.set_value(to, row, value);
            }
        }
    }

    /// Sets all numbers of one splat to zero.
    pub(crate) fn zero(&mut self, i: usize) {
        for row in 0..self.stride {
            self.set_value(i, row, 0.0);
        }
    }
}

/// Fills `blocks` with the parameters of `splats`, in the SH degree of `blocks`. Missing coefficients become zero;
/// coefficients of higher degrees are dropped.
pub(crate) fn store_splats(blocks: &mut Blocks, splats: &Splats) {
    blocks.resize(0);
    blocks.resize(splats.len());
    let sh_rows = (blocks.stride() - SH).min(splats.sh_stride());
    for i in 0..splats.len() {
        let mut put = |first: usize, values: &[f32]| {
            for (k, value) in values.iter().enumerate() {
                blocks.set_value(i, first + k, *value);
            }
        };
        put(MEAN, &splats.means[i]);
        put(QUAT, &splats.quats[i]);
        put(LOG_SCALE, &splats.log_scales[i]);
        put(OPACITY, &[splats.opacity_logits[i]]);
        put(SH, &splats.sh_of(i)[..sh_rows]);
    }
}

/// Reads the splats from blocks with SH degree `sh_degree`.
pub(crate) fn load_splats(blocks: &Blocks, sh_degree: u32) -> Splats {
    let mut splats = Splats::with_capacity(blocks.len(), sh_degree);
    let mut sh = vec![0.0; splats.sh_stride()];
    for i in 0..blocks.len() {
        let get = |row| blocks.value(i, row);
        for (k, value) in sh.iter_mut().enumerate() {
            *value = get(SH + k);
        }
        splats.push(
            [0, 1, 2].map(|k| get(MEAN + k)),
            [0, 1, 2, 3].map(|k| get(QUAT + k)),
            [0, 1, 2].map(|k| get(LOG_SCALE + k)),
            get(OPACITY),
            &sh,
        );
    }
    splats
}
