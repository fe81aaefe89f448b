//! Adds and removes splats. The processor decides which splats move where, and the GPU moves their numbers: reading and
//! writing every row instead took half the time of a training on a graphics card.

use super::buffer::Buffer;
use super::context::Gpu;
use super::model::Model;
use super::pass::Pass;
use super::recorder::Recorder;
use super::sort::GROUP;
use super::structs::EditStep;
use super::train::Training;
use crate::backend::{Birth, Edit};
use crate::layout::rows::{LOG_SCALE, MEAN, OPACITY, QUAT, RECORD_LEN, SH};

/// The moves of an edit: what changes its place, and what is born. [`Edit`] describes their order.
#[derive(Debug, PartialEq)]
struct Moves<'a> {
    /// Place after and before the edit of each splat that moves; then for each new splat its place and its parent's.
    places: Vec<[u32; 2]>,
    /// The new splats.
    births: &'a [Birth],
    /// Number of splats after the edit.
    len: usize,
}

impl<'a> Moves<'a> {
    /// The moves in a model of `len` splats.
    fn new(len: usize, edit: &'a Edit) -> Self {
        let Edit { births, deaths } = edit;
        assert!(deaths.windows(2).all(|pair| pair[0] < pair[1]), "deaths ascend");
        let holes = &deaths[births.len().min(deaths.len())..];
        let end = len + births.len() - deaths.len();
        // What lives beyond the end, the last first, fills the holes before the end.
        let living = (end as u32..len as u32).rev().filter(|place| holes.binary_search(place).is_err());
        let fills = holes.iter().zip(living).map(|(hole, last)| [*hole, last]);
        let free = deaths.iter().copied().chain(len as u32..);
        let born = births.iter().zip(free).map(|(birth, place)| [place, birth.parent]);
        Self { places: fills.chain(born).collect(), births, len: end }
    }
}

/// The numbers that new splats get in the rows of a buffer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Newborn {
    /// 0.
    Zero,
    /// Those of their parents.
    Parents,
    /// Their own where [`own`] returns one, otherwise those of their parents.
    Own,
}

/// The passes of an edit, and their parameters.
#[derive(Debug)]
pub(super) struct Editor {
    gather: Pass,
    scatter: Pass,
    step: Buffer<EditStep>,
}

impl Editor {
    pub(super) fn new(gpu: &Gpu) -> Self {
        Self {
            gather: gpu.pass(cosurf_shaders::EDIT_GATHER),
            scatter: gpu.pass(cosurf_shaders::EDIT_SCATTER),
            step: Buffer::uniform(gpu, "step of an edit", bytemuck::Zeroable::zeroed()),
        }
    }

    /// Adds and removes splats. The moments of new splats and all statistics become zero.
    pub(super) fn apply(&self, gpu: &Gpu, model: &mut Model, training: &Training, edit: &Edit) {
        let moves = Moves::new(model.len, edit);
        assert!(moves.len <= model.stride, "{} splats of {}", moves.len, model.stride);
        training.scores.write_bytes(gpu, 0, bytemuck::cast_slice(&moves.places));
        for moments in &training.moments {
            self.move_rows(gpu, model, training, moments, &moves, Newborn::Zero);
        }
        self.move_rows(gpu, model, training, &model.sh, &moves, Newborn::Parents);
        self.move_rows(gpu, model, training, &model.shape, &moves, Newborn::Own);
        model.len = moves.len;
        training.stats.clear(gpu);
    }

    /// Moves the numbers of every row of a buffer, as many rows at a time as fit into the records.
    fn move_rows(
        &self,
        gpu: &Gpu,
        model: &Model,
        training: &Training,
        buffer: &Buffer<f32>,
        moves: &Moves<'_>,
        newborn: Newborn,
    ) {
        let (Training { scores, records, .. }, count) = (training, moves.places.len());
        if count == 0 {
            return;
        }
        let rows_at_once = RECORD_LEN * records.len() / count;
        let rows = buffer.len() / model.stride;
        for first in (0..rows).step_by(rows_at_once) {
            let rows = rows_at_once.min(rows - first);
            let step = EditStep {
                first_row: first as u32,
                rows: rows as u32,
                splat_stride: model.stride as u32,
                moves: count as u32,
                copied: (count - if newborn == Newborn::Zero { moves.births.len() } else { 0 }) as u32,
            };
            self.step.write(gpu, 0, &[step]);
            let (step, groups) = (&self.step.raw, (rows * count).div_ceil(GROUP));
            let mut r = Recorder::new(gpu);
            r.run(&self.gather, &[step, &scores.raw, &buffer.raw, &records.raw], groups);
            r.submit();
            for row in (0..rows).filter(|_| newborn == Newborn::Own) {
                let own: Vec<f32> = moves.births.iter().filter_map(|birth| own(first + row, birth)).collect();
                let first_born = (row + 1) * count - moves.births.len();
                records.write_bytes(gpu, first_born, bytemuck::cast_slice(&own));
            }
            let mut r = Recorder::new(gpu);
            r.run(&self.scatter, &[step, &scores.raw, &records.raw, &buffer.raw], groups);
            r.submit();
        }
    }
}

/// Lowers every opacity to at most `opacity`; the moments of opacities become zero.
pub(super) fn cap_opacity(gpu: &Gpu, model: &Model, training: &Training, opacity: f32) {
    let limit = libm::logf(opacity / (1.0 - opacity));
    let (first, end) = (OPACITY * model.stride, OPACITY * model.stride + model.len);
    let lowered: Vec<f32> =
        model.shape.read(gpu, first..end).into_iter().map(|logit| logit.min(limit)).collect();
    model.shape.write(gpu, first, &lowered);
    let zeros = vec![0.0; model.len];
    training.moments[..2].iter().for_each(|moments| moments.write(gpu, first, &zeros));
}

/// The number of a new splat in a row of the shapes, or `None` if it is that of its parent.
fn own(row: usize, birth: &Birth) -> Option<f32> {
    match row {
        MEAN..QUAT => Some(birth.mean[row - MEAN]),
        LOG_SCALE..OPACITY => Some(birth.log_scale[row - LOG_SCALE]),
        OPACITY..SH => Some(birth.opacity_logit),
        _ => None,
    }
}
