//! What a checkpoint keeps, in the order of the CPU backend, so that a training may go on where another device left
//! it: tables of parameters, first moments, second moments and statistics; in each, blocks of 16 splats; in a block,
//! 16 numbers for each row.

use super::backend::GpuBackend;
use super::buffer::Buffer;
use super::model::{SHAPE_ROWS, sh_rows};
use super::train::STAT_ROWS;
use crate::cpu::simd::GROUP;

/// Splats that are copied at a time: what bounds the memory that a checkpoint takes.
const SPLATS_AT_ONCE: usize = 1024 * GROUP;

/// Rows of splats: the buffer of each, and where in it the row begins.
type Table<'a> = Vec<(&'a Buffer<f32>, usize)>;

impl GpuBackend {
    fn tables(&self) -> [Table<'_>; 4] {
        let rows = |buffer, rows: usize| (0..rows).map(move |row| (buffer, row * self.model.stride));
        let both = |shape, sh| rows(shape, SHAPE_ROWS).chain(rows(sh, sh_rows(self.model.sh_degree)));
        let [shape_first, shape_second, sh_first, sh_second] = &self.training.moments;
        [
            both(&self.model.shape, &self.model.sh).collect(),
            both(shape_first, sh_first).collect(),
            both(shape_second, sh_second).collect(),
            rows(&self.training.stats, STAT_ROWS).collect(),
        ]
    }

    /// First and last of the splats that are copied together.
    fn pieces(&self) -> impl Iterator<Item = (usize, usize)> + use<> {
        let len = self.model.len;
        (0..len).step_by(SPLATS_AT_ONCE).map(move |first| (first, (first + SPLATS_AT_ONCE).min(len)))
    }

    pub(super) fn visit_kept<E>(&self, mut visit: impl FnMut(&[f32]) -> Result<(), E>) -> Result<(), E> {
        for table in self.tables() {
            for (first, end) in self.pieces() {
                let mut numbers = vec![0.0; (end - first).div_ceil(GROUP) * GROUP * table.len()];
                for (row, (buffer, start)) in table.iter().enumerate() {
                    let values = buffer.read(&self.gpu, start + first..start + end);
                    for (i, value) in values.into_iter().enumerate() {
                        numbers[place(i, row, table.len())] = value;
                    }
                }
                visit(&numbers)?;
            }
        }
        Ok(())
    }

    pub(super) fn fill_kept<E>(
        &mut self,
        len: usize,
        mut fill: impl FnMut(&mut [f32]) -> Result<(), E>,
    ) -> Result<(), E> {
        assert!(len <= self.model.stride, "{len} splats of {}", self.model.stride);
        self.model.len = len;
        for table in self.tables() {
            for (first, end) in self.pieces() {
                let mut numbers = vec![0.0; (end - first).div_ceil(GROUP) * GROUP * table.len()];
                fill(&mut numbers)?;
                for (row, (buffer, start)) in table.iter().enumerate() {
                    let values: Vec<f32> =
                        (0..end - first).map(|i| numbers[place(i, row, table.len())]).collect();
                    buffer.write(&self.gpu, start + first, &values);
                }
            }
        }
        Ok(())
    }
}

/// Where a row's number of the `i`-th splat of a piece lies.
fn place(i: usize, row: usize, rows: usize) -> usize {
    (i / GROUP * rows + row) * GROUP + i % GROUP
}
