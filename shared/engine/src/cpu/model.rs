//! The splats of a backend with their training state, and how splats are added and removed.

use cosurf_scene::Splats;
use rayon::prelude::*;

use super::blocks::{self, Blocks};
use crate::backend::{Birth, Edit, Shapes};
use crate::budget::Capacity;
use crate::layout::rows::{
    GRADIENT_ROWS, LOG_SCALE, MEAN, OPACITY, QUAT, STAT_ABSOLUTE_GRADIENT, STAT_ROWS, STAT_SCREEN_GRADIENT,
    STAT_VIEWS, parameter_rows,
};

/// Adam's first and second moments, laid out like the parameters.
#[derive(Debug)]
pub(crate) struct Moments {
    pub(crate) first: Blocks,
    pub(crate) second: Blocks,
}

/// All splats with their training state. In training, all tables have the same number of splats; for rendering only
/// `params` is used.
#[derive(Debug)]
pub(crate) struct Model {
    capacity: usize,
    sh_degree: u32,
    is_training: bool,
    pub(crate) params: Blocks,
    pub(crate) moments: Moments,
    pub(crate) gradients: Blocks,
    pub(crate) stats: Blocks,
}

impl Model {
    /// An empty model with room for the splats of `capacity`.
    pub(crate) fn with_capacity(capacity: &Capacity) -> Self {
        let Capacity { splats, sh_degree, training, .. } = *capacity;
        let trained = if training { splats } else { 0 };
        let rows = parameter_rows(sh_degree);
        Self {
            capacity: splats,
            sh_degree,
            is_training: training,
            params: Blocks::with_capacity(splats, rows),
            moments: Moments {
                first: Blocks::with_capacity(trained, rows),
                second: Blocks::with_capacity(trained, rows),
            },
            gradients: Blocks::with_capacity(trained, GRADIENT_ROWS),
            stats: Blocks::with_capacity(trained, STAT_ROWS),
        }
    }

    pub(crate) fn len(&self) -> usize {
        self.params.len()
    }

    /// Largest number of splats.
    pub(crate) fn capacity(&self) -> usize {
        self.capacity
    }

    /// Stored SH degree.
    pub(crate) fn sh_degree(&self) -> u32 {
        self.sh_degree
    }

    /// Replaces all splats; moments and statistics become zero.
    pub(crate) fn load(&mut self, splats: &Splats) {
        self.check(splats.len());
        blocks::store_splats(&mut self.params, splats);
        if self.is_training {
            for blocks in
                [&mut self.moments.first, &mut self.moments.second, &mut self.gradients, &mut self.stats]
            {
                blocks.resize(0);
                blocks.resize(splats.len());
            }
        }
    }

    /// The splats as they are now.
    pub(crate) fn splats(&self) -> Splats {
        blocks::load_splats(&self.params, self.sh_degree)
    }

    /// The splats as they are now. The training state is freed before they are copied.
    pub(crate) fn into_splats(self) -> Splats {
        let sh_degree = self.sh_degree;
        blocks::load_splats(&self.into_params(), sh_degree)
    }

    /// The parameters; all else is freed.
    fn into_params(self) -> Blocks {
        self.params
    }

    /// Returns the shapes and mean statistics of all splats, and sets the stored statistics to zero.
    pub(crate) fn take_shapes(&mut self) -> Shapes {
        let (params, stats) = (&self.params, &self.stats);
        let n = params.len();
        let each = || (0..n).into_par_iter();
        let views: Vec<f32> = each().map(|i| stats.value(i, STAT_VIEWS)).collect();
        let mean = |row: usize| each().map(|i| stats.value(i, row) / views[i].max(1.0)).collect();
        let shapes = Shapes {
            means: each().map(|i| [0, 1, 2].map(|k| params.value(i, MEAN + k))).collect(),
            quats: each().map(|i| [0, 1, 2, 3].map(|k| params.value(i, QUAT + k))).collect(),
            log_scales: each().map(|i| [0, 1, 2].map(|k| params.value(i, LOG_SCALE + k))).collect(),
            opacity_logits: each().map(|i| params.value(i, OPACITY)).collect(),
            screen_gradients: mean(STAT_SCREEN_GRADIENT),
            absolute_gradients: mean(STAT_ABSOLUTE_GRADIENT),
            views,
        };
        self.stats.fill_zero();
        shapes
    }

    /// Adds and removes splats.
    pub(crate) fn edit(&mut self, edit: &Edit) {
        let old_len = self.params.len();
        let (births, deaths) = (edit.births.len(), edit.deaths.len());
        let new_len = old_len + births - deaths;
        self.check(new_len);
        assert!(edit.deaths.windows(2).all(|pair| pair[0] < pair[1]), "deaths ascend");
        self.resize(old_len.max(new_len));

        // A new splat may take the place of a removed splat from which another new splat is copied, so all copies are
        // made first.
        let children: Vec<Vec<f32>> = edit.births.par_iter().map(|birth| self.numbers_of(birth)).collect();
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

    /// Parameters of a new splat.
    fn numbers_of(&self, birth: &Birth) -> Vec<f32> {
        let parent = birth.parent as usize;
        let mut numbers: Vec<f32> =
            (0..self.params.stride()).map(|row| self.params.value(parent, row)).collect();
        numbers[MEAN..MEAN + 3].copy_from_slice(&birth.mean);
        numbers[LOG_SCALE..LOG_SCALE + 3].copy_from_slice(&birth.log_scale);
        numbers[OPACITY] = birth.opacity_logit;
        numbers
    }

    /// Moves the last of `len` splats into `holes` (ascending), so that the first `len - holes.len()` places have no
    /// holes.
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

    /// Lowers every opacity to at most `opacity`; the moments of opacities become zero.
    pub(crate) fn cap_opacity(&mut self, opacity: f32) {
        let limit = libm::logf(opacity / (1.0 - opacity));
        for i in 0..self.params.len() {
            let value = self.params.value(i, OPACITY).min(limit);
            self.params.set_value(i, OPACITY, value);
            self.moments.first.set_value(i, OPACITY, 0.0);
            self.moments.second.set_value(i, OPACITY, 0.0);
        }
    }

    /// Visits parameters, moments and statistics, table by table, 16 numbers at a time. Stops at the first error.
    pub(crate) fn export<E>(&self, mut visit: impl FnMut(&[f32]) -> Result<(), E>) -> Result<(), E> {
        for blocks in [&self.params, &self.moments.first, &self.moments.second, &self.stats] {
            blocks.rows().iter().try_for_each(|row| visit(&row.0))?;
        }
        Ok(())
    }

    /// Restores `len` splats from what [`Self::export`] visited.
    pub(crate) fn import<E>(
        &mut self,
        len: usize,
        mut fill: impl FnMut(&mut [f32]) -> Result<(), E>,
    ) -> Result<(), E> {
        self.check(len);
        self.gradients.resize(len);
        for blocks in [&mut self.params, &mut self.moments.first, &mut self.moments.second, &mut self.stats] {
            blocks.resize(len);
            blocks.rows_mut().iter_mut().try_for_each(|row| fill(&mut row.0))?;
        }
        Ok(())
    }

    fn check(&self, len: usize) {
        assert!(len <= self.capacity, "{len} splats of {}", self.capacity);
    }
}
