//! Changing which splats there are.

use super::CpuBackend;
use super::blocks::{Blocks, LOG_SCALE, MEAN, OPACITY};
use crate::backend::{Birth, Edit};

impl CpuBackend {
    /// Moments, gradients and statistics of the present number of splats, all zero.
    pub(super) fn reset_training_state(&mut self) {
        let len = self.params.len();
        for blocks in
            [&mut self.moments.first, &mut self.moments.second, &mut self.gradients, &mut self.stats]
        {
            blocks.resize(0);
            blocks.resize(len);
        }
    }

    pub(super) fn apply(&mut self, edit: &Edit) {
        let old_len = self.params.len();
        let (births, deaths) = (edit.births.len(), edit.deaths.len());
        let new_len = old_len + births - deaths;
        assert!(new_len <= self.capacity.splats, "{new_len} splats of {}", self.capacity.splats);
        assert!(edit.deaths.windows(2).all(|pair| pair[0] < pair[1]), "deaths ascend");
        self.resize(old_len.max(new_len));

        // A parent may be dead, and its place may be given to another's child: read parents first.
        let children: Vec<Vec<f32>> = edit.births.iter().map(|birth| self.numbers_of(birth)).collect();
        let free = edit.deaths.iter().map(|i| *i as usize).chain(old_len..);
        for (numbers, place) in children.iter().zip(free) {
            for (row, value) in numbers.iter().enumerate() {
                self.params.set_value(place, row, *value);
            }
            self.moments.first.zero(place);
            self.moments.second.zero(place);
        }
        self.fill_holes(&edit.deaths[births.min(deaths)..], old_len);
        self.resize(new_len);
        self.stats.fill_zero();
    }

    /// Parameters of a newborn.
    fn numbers_of(&self, birth: &Birth) -> Vec<f32> {
        let parent = birth.parent as usize;
        let mut numbers: Vec<f32> =
            (0..self.params.stride()).map(|row| self.params.value(parent, row)).collect();
        numbers[MEAN..MEAN + 3].copy_from_slice(&birth.mean);
        numbers[LOG_SCALE..LOG_SCALE + 3].copy_from_slice(&birth.log_scale);
        numbers[OPACITY] = birth.opacity_logit;
        numbers
    }

    /// Moves living splats from the end into `holes` (ascending), then the end is free.
    fn fill_holes(&mut self, holes: &[u32], len: usize) {
        let new_len = len - holes.len();
        let mut last = len;
        let mut dead = holes.iter().rev().copied().peekable();
        for &hole in holes.iter().take_while(|hole| (**hole as usize) < new_len) {
            last -= 1;
            while dead.peek().is_some_and(|d| *d as usize == last) {
                dead.next();
                last -= 1;
            }
            for blocks in self.per_splat() {
                blocks.copy(last, hole as usize);
            }
        }
    }

    fn per_splat(&mut self) -> [&mut Blocks; 3] {
        [&mut self.params, &mut self.moments.first, &mut self.moments.second]
    }

    fn resize(&mut self, len: usize) {
        self.per_splat().into_iter().for_each(|blocks| blocks.resize(len));
        self.gradients.resize(len);
        self.stats.resize(len);
    }

    pub(super) fn lower_opacities(&mut self, opacity: f32) {
        let limit = (opacity / (1.0 - opacity)).ln();
        for i in 0..self.params.len() {
            let value = self.params.value(i, OPACITY).min(limit);
            self.params.set_value(i, OPACITY, value);
            self.moments.first.set_value(i, OPACITY, 0.0);
            self.moments.second.set_value(i, OPACITY, 0.0);
        }
    }
}
