//! Adds and removes splats: the processor reads every row of the splats from the GPU, changes it and writes it back.
//! This is slow, but refinements happen only every 20 to 100 steps.

use super::buffer::Buffer;
use super::context::Gpu;
use super::model::Model;
use super::train::Training;
use crate::backend::{Birth, Edit};
use crate::layout::rows::{LOG_SCALE, MEAN, OPACITY, QUAT, SH};

/// Where the numbers of a splat come from.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Source {
    /// From the splat with this index before the edit.
    Old(usize),
    /// From a new splat.
    Born(Birth),
}

/// The source of each splat after an edit. [`Edit`] describes their order.
fn places(len: usize, edit: &Edit) -> Vec<Source> {
    assert!(edit.deaths.windows(2).all(|pair| pair[0] < pair[1]), "deaths ascend");
    let mut places: Vec<Source> = (0..len).map(Source::Old).collect();
    let mut free = edit.deaths.iter().map(|dead| *dead as usize);
    for birth in &edit.births {
        match free.next() {
            Some(place) => places[place] = Source::Born(*birth),
            None => places.push(Source::Born(*birth)),
        }
    }
    let holes: Vec<usize> = free.collect();
    let end = places.len() - holes.len();
    let mut living = (end..places.len()).rev().filter(|place| holes.binary_search(place).is_err());
    for hole in holes.iter().copied().take_while(|hole| *hole < end) {
        let last = living.next().expect("as many splats live beyond the end as holes lie before it");
        places[hole] = places[last];
    }
    places.truncate(end);
    places
}

/// Adds and removes splats. The moments of new splats and all statistics become zero.
pub(super) fn apply(gpu: &Gpu, model: &mut Model, training: &Training, edit: &Edit) {
    let places = places(model.len, edit);
    assert!(places.len() <= model.stride, "{} splats of {}", places.len(), model.stride);
    let zero = |_: usize, _: &Birth| 0.0;
    for moments in &training.moments {
        move_rows(gpu, model, moments, &places, |_, _| None, zero);
    }
    move_rows(gpu, model, &model.sh, &places, |_, birth| Some(birth.parent as usize), zero);
    move_rows(
        gpu,
        model,
        &model.shape,
        &places,
        |row, birth| own(row, birth).is_none().then_some(birth.parent as usize),
        |row, birth| own(row, birth).unwrap_or(0.0),
    );
    model.len = places.len();
    training.stats.clear(gpu);
}

/// Rewrites each row of a buffer in the order of `places`. In a row, a new splat gets the number of the old splat whose
/// index `parent` returns. If `parent` returns `None`, it gets the number that `own` returns.
fn move_rows(
    gpu: &Gpu,
    model: &Model,
    buffer: &Buffer<f32>,
    places: &[Source],
    parent: impl Fn(usize, &Birth) -> Option<usize>,
    own: impl Fn(usize, &Birth) -> f32,
) {
    let (stride, len) = (model.stride, model.len);
    for row in 0..buffer.len() / stride {
        let old = buffer.read(gpu, row * stride..row * stride + len);
        let value = |source: &Source| match source {
            Source::Old(place) => old[*place],
            Source::Born(birth) => parent(row, birth).map_or_else(|| own(row, birth), |place| old[place]),
        };
        let new: Vec<f32> = places.iter().map(value).collect();
        buffer.write(gpu, row * stride, &new);
    }
}

/// Lowers every opacity to at most `opacity`; the moments of opacities become zero.
pub(super) fn cap_opacity(gpu: &Gpu, model: &Model, training: &Training, opacity: f32) {
    let limit = (opacity / (1.0 - opacity)).ln();
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
