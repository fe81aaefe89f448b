//! Checkpoints in the order of the CPU backend, so that a training can resume on another device: tables of parameters,
//! first moments, second moments and statistics; in each, blocks of 16 splats; in a block, 16 numbers for each row.

use super::buffer::Buffer;
use super::context::Gpu;
use super::model::Model;
use super::train::Training;
use crate::layout::rows::{SH, STAT_ROWS, sh_rows};
use crate::simd::GROUP;

/// Splats that are copied at a time, which limits the memory of a checkpoint.
const SPLATS_AT_ONCE: usize = 1024 * GROUP;

/// Rows of splats: the buffer of each, and the start of the row in it.
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

/// First and end of the splats that are copied together.
fn pieces(len: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..len).step_by(SPLATS_AT_ONCE).map(move |first| (first, (first + SPLATS_AT_ONCE).min(len)))
}

/// Visits all tables, piece by piece.
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

/// Index of a row's number of the `i`-th splat of a piece.
fn place(i: usize, row: usize, rows: usize) -> usize {
    (i / GROUP * rows + row) * GROUP + i % GROUP
}
