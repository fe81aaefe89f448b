//! Changing which splats there are: worked out on the processor, every hundred steps or so, with all rows read and
//! written once.

use super::backend::GpuBackend;
use super::buffer::Buffer;
use super::model::SHAPE_ROWS;
use crate::backend::{Birth, Edit};

/// Rows of a shape that a newborn does not have from its parent.
const MEAN: usize = 0;
const LOG_SCALE: usize = 7;
const OPACITY: usize = 10;

/// Whose numbers a place gets.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Source {
    /// Those of the splat that was at this place before.
    Old(usize),
    /// Those of a newborn.
    Born(Birth),
}

/// The places after an edit: births go to the places of the dead first, then to the end; places that are still
/// empty are filled from the end.
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

impl GpuBackend {
    pub(super) fn apply(&mut self, edit: &Edit) {
        let places = places(self.model.len, edit);
        assert!(places.len() <= self.model.stride, "{} splats of {}", places.len(), self.model.stride);
        let zero = |_: usize, _: &Birth| 0.0;
        let [shape_first, shape_second, sh_first, sh_second] = &self.training.moments;
        for moments in [shape_first, shape_second, sh_first, sh_second] {
            self.move_rows(moments, &places, |_, _| None, zero);
        }
        self.move_rows(&self.model.sh, &places, |_, birth| Some(birth.parent as usize), zero);
        self.move_rows(
            &self.model.shape,
            &places,
            |row, birth| own(row, birth).is_none().then_some(birth.parent as usize),
            |row, birth| own(row, birth).unwrap_or(0.0),
        );
        self.model.len = places.len();
        self.clear(&self.training.stats);
    }

    /// Rewrites each row of a buffer: newborns get what `parent` names, or else what `own` says.
    fn move_rows(
        &self,
        buffer: &Buffer<f32>,
        places: &[Source],
        parent: impl Fn(usize, &Birth) -> Option<usize>,
        own: impl Fn(usize, &Birth) -> f32,
    ) {
        let (stride, len) = (self.model.stride, self.model.len);
        for row in 0..buffer.len() / stride {
            let old = buffer.read(&self.gpu, row * stride..row * stride + len);
            let value = |source: &Source| match source {
                Source::Old(place) => old[*place],
                Source::Born(birth) => parent(row, birth).map_or_else(|| own(row, birth), |place| old[place]),
            };
            let new: Vec<f32> = places.iter().map(value).collect();
            buffer.write(&self.gpu, row * stride, &new);
        }
    }

    pub(super) fn lower_opacities(&mut self, opacity: f32) {
        let limit = (opacity / (1.0 - opacity)).ln();
        let (first, end) = (OPACITY * self.model.stride, OPACITY * self.model.stride + self.model.len);
        let lowered: Vec<f32> =
            self.model.shape.read(&self.gpu, first..end).into_iter().map(|logit| logit.min(limit)).collect();
        self.model.shape.write(&self.gpu, first, &lowered);
        let zeros = vec![0.0; self.model.len];
        self.training.moments[..2].iter().for_each(|moments| moments.write(&self.gpu, first, &zeros));
    }
}

/// What of a newborn's shape is its own.
fn own(row: usize, birth: &Birth) -> Option<f32> {
    match row {
        MEAN..3 => Some(birth.mean[row]),
        LOG_SCALE..OPACITY => Some(birth.log_scale[row - LOG_SCALE]),
        OPACITY..SHAPE_ROWS => Some(birth.opacity_logit),
        _ => None,
    }
}
