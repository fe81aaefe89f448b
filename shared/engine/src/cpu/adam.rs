//! The optimiser pass: Adam on all splats, visible or not.
//!
//! A splat that the camera does not see has gradient zero, but its momentum still moves it. Skipping such splats
//! ("sparse Adam") is faster for large models, but loses quality. The SH gradients are products of
//! the colour gradient and the basis. They are computed here, so they need no memory.

use cosurf_scene::splats::sh_coefficients;
use rayon::prelude::*;

use super::blocks::Blocks;
use super::model::Moments;
use crate::backend::{AdamRates, BETA_1, BETA_2, EPSILON};
use crate::layout::harmonics::{self, view_direction};
use crate::layout::rows::{GRADIENT_RGB, GRADIENT_ROWS, LOG_SCALE, MEAN, OPACITY, QUAT, SH};
use crate::layout::view::ViewParams;
use crate::simd::{GROUP, Isa, Kernel, Lanes, Row, each};

/// Makes one Adam step on every splat. Each entry of `visible` has one bit for each splat of a block. Splats that are
/// not visible have gradient zero, whatever `gradients` holds. SH coefficients above the degree of `view` stay
/// unchanged.
pub(crate) fn adam(
    isa: Isa,
    params: &mut Blocks,
    moments: &mut Moments,
    gradients: &Blocks,
    visible: &[u16],
    view: &ViewParams,
    rates: &AdamRates,
) {
    let stride = params.stride();
    params
        .rows_mut()
        .par_chunks_exact_mut(stride)
        .zip(moments.first.rows_mut().par_chunks_exact_mut(stride))
        .zip(moments.second.rows_mut().par_chunks_exact_mut(stride))
        .zip(gradients.rows().par_chunks_exact(GRADIENT_ROWS))
        .zip(visible.par_iter())
        .with_min_len(64)
        .for_each(|((((params, first), second), gradients), &visible)| {
            isa.run(AdamBlock { params, first, second, gradients, visible, view, rates });
        });
}

struct AdamBlock<'a> {
    params: &'a mut [Row],
    first: &'a mut [Row],
    second: &'a mut [Row],
    gradients: &'a [Row],
    visible: u16,
    view: &'a ViewParams,
    rates: &'a AdamRates,
}

impl Kernel for AdamBlock<'_> {
    type Output = ();

    #[inline(always)]
    fn run<L: Lanes>(mut self) {
        let mut seen = Row::ZERO;
        for (lane, value) in seen.0.iter_mut().enumerate() {
            *value = f32::from(self.visible >> lane & 1);
        }
        for part in 0..GROUP / L::N {
            self.part::<L>(part, L::splat(0.5).lt(seen.get::<L>(part)));
        }
    }
}

impl AdamBlock<'_> {
    #[inline(always)]
    fn part<L: Lanes>(&mut self, part: usize, mask: L::Mask) {
        let mean = each!([0, 1, 2], |a| self.params[MEAN + a].get::<L>(part));
        // The viewing direction of the forward pass; the mean has not moved yet.
        let (dir, _) = view_direction(mean, self.view);
        let basis = harmonics::basis(dir, self.view.sh_degree);
        let r = *self.rates;
        for (first, count, rate) in
            [(MEAN, 3, r.mean), (QUAT, 4, r.quat), (LOG_SCALE, 3, r.log_scale), (OPACITY, 1, r.opacity)]
        {
            for row in first..first + count {
                self.update::<L>(row, part, self.gradient(row, part, mask), rate);
            }
        }
        let v_rgb = each!([0, 1, 2], |c| self.gradient::<L>(GRADIENT_RGB + c, part, mask));
        for (k, y) in basis.iter().enumerate().take(sh_coefficients(self.view.sh_degree)) {
            let rate = if k == 0 { r.sh_dc } else { r.sh_rest };
            for (channel, v) in v_rgb.iter().enumerate() {
                self.update::<L>(SH + 3 * k + channel, part, *y * *v, rate);
            }
        }
    }

    /// The gradients of a row, and 0 where the mask is false. This is a function because a closure was not inlined with AVX2.
    #[inline(always)]
    fn gradient<L: Lanes>(&self, row: usize, part: usize, mask: L::Mask) -> L {
        self.gradients[row].get::<L>(part).keep(mask)
    }

    #[inline(always)]
    fn update<L: Lanes>(&mut self, row: usize, part: usize, g: L, rate: f32) {
        let first = self.first[row].get::<L>(part);
        let first = L::splat(BETA_1).mul_add(first, L::splat(1.0 - BETA_1) * g);
        let second = self.second[row].get::<L>(part);
        let second = L::splat(BETA_2).mul_add(second, L::splat(1.0 - BETA_2) * g * g);
        let size = (second * L::splat(self.rates.second_correction)).sqrt() + L::splat(EPSILON);
        let step = L::splat(rate * self.rates.first_correction) * first / size;
        let moved = self.params[row].get::<L>(part) - step;
        self.params[row].set(part, moved);
        self.first[row].set(part, first);
        self.second[row].set(part, second);
    }
}
