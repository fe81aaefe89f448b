//! Checkpoints, with their numbers in the order of the CPU backend, so that a training can resume on another device.
//! There are four tables: parameters, first moments, second moments and statistics. A table consists of blocks of 16
//! splats; a block has 16 numbers for each row, one for each splat.

use super::buffer::Buffer;
use super::context::Gpu;
use super::model::Model;
use super::train::Training;
use crate::layout::rows::{SH, STAT_ROWS, sh_rows};
use crate::simd::GROUP;

/// Number of splats that are copied at a time, which limits the memory that a checkpoint takes.
const SPLATS_AT_ONCE: usize = 1024 * GROUP;

/// The rows of a table: for each row its buffer, and the index in the buffer where the row starts.
type Table<'a> = Vec<(&'a Buffer<f32>, usize)>;

fn tables<'a>(model: &'a Model, training: &'a Training) -> [Table<'a>; 4] {
    let rows = |buffer, rows: usize| (0..rows).map(move |row| (buffer, row * model.stride));
    let both = |shape, sh| rows(shape, SH).chain(rows(sh, sh_rows(model.sh_degree)));
    let [shape_first, shape_second, sh_first, sh_second] = &training.moments;
    [
        both(&model.shape, &model.sh).collect(),
        both(shape_first, sh_first).collect(),
        both(shape_second, sh_second).collect(),
        rows(&training.stats, STAT_ROWS).collect(),
    ]
}

/// Divides `len` splats into pieces that are copied together: first index and end of each piece.
fn pieces(len: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..len).step_by(SPLATS_AT_ONCE).map(move |first| (first, (first + SPLATS_AT_ONCE).min(len)))
}

/// Visits all tables, piece by piece. Stops at the first error.
pub(super) fn export<E>(
    gpu: &Gpu,
    model: &Model,
    training: &Training,
    mut visit: impl FnMut(&[f32]) -> Result<(), E>,
) -> Result<(), E> {
    for table in tables(model, training) {
        for (first, end) in pieces(model.len) {
            let mut numbers = vec![0.0; (end - first).div_ceil(GROUP) * GROUP * table.len()];
            for (row, (buffer, start)) in table.iter().enumerate() {
                let values = buffer.read(gpu, start + first..start + end);
                for (i, value) in values.into_iter().enumerate() {
                    numbers[place(i, row, table.len())] = value;
                }
            }
            visit(&numbers)?;
        }
    }
    Ok(())
}

/// Restores `len` splats from what [`export`] visited.
pub(super) fn import<E>(
    gpu: &Gpu,
    model: &mut Model,
    training: &Training,
    len: usize,
    mut fill: impl FnMut(&mut [f32]) -> Result<(), E>,
) -> Result<(), E> {
    assert!(len <= model.stride, "{len} splats of {}", model.stride);
    model.len = len;
    for table in tables(model, training) {
        for (first, end) in pieces(len) {
            let mut numbers = vec![0.0; (end - first).div_ceil(GROUP) * GROUP * table.len()];
            fill(&mut numbers)?;
            for (row, (buffer, start)) in table.iter().enumerate() {
                let values: Vec<f32> =
                    (0..end - first).map(|i| numbers[place(i, row, table.len())]).collect();
                buffer.write(gpu, start + first, &values);
            }
        }
    }
    Ok(())
}

/// Index of a number in a piece of a table with `rows` rows: the number in row `row` of the piece's `i`-th splat.
fn place(i: usize, row: usize, rows: usize) -> usize {
    (i / GROUP * rows + row) * GROUP + i % GROUP
}
