//! The order of a splat's numbers in the tables of both backends: one row for each number.

use cosurf_scene::splats::sh_coefficients;

/// First row of each parameter: mean xyz, quaternion wxyz, log-scale, opacity logit, then SH as `[coefficient, rgb]`.
pub(crate) const MEAN: usize = 0;
pub(crate) const QUAT: usize = 3;
pub(crate) const LOG_SCALE: usize = 7;
pub(crate) const OPACITY: usize = 10;
pub(crate) const SH: usize = 11;

/// Rows of the SH coefficients.
pub(crate) const fn sh_rows(sh_degree: u32) -> usize {
    3 * sh_coefficients(sh_degree)
}

/// Rows of all parameters.
pub(crate) const fn parameter_rows(sh_degree: u32) -> usize {
    SH + sh_rows(sh_degree)
}

/// Rows of a gradient: mean, quaternion, log-scale and opacity logit as in the parameters, then ∂L/∂rgb of the seen
/// colour. The SH gradients are its product with the basis; the optimiser forms them on the fly.
pub(crate) const GRADIENT_RGB: usize = SH;
pub(crate) const GRADIENT_ROWS: usize = GRADIENT_RGB + 3;

/// Rows of the densification statistics: the sum over views of the norm of ∂L/∂mean on the screen, in units of half the
/// picture (the measure of 3DGS); the number of views that saw the splat; and the same norm of the sums of absolute
/// values over pixels (AbsGS).
pub(crate) const STAT_SCREEN_GRADIENT: usize = 0;
pub(crate) const STAT_VIEWS: usize = 1;
pub(crate) const STAT_ABSOLUTE_GRADIENT: usize = 2;
pub(crate) const STAT_ROWS: usize = 3;

/// Rows of the scores: Σ (α T)², pixels hit, and views that observed the splat. In the record of one splat–tile pair
/// the last is the number of pixels hit while more than half of the light still came through.
pub(crate) const SQUARED_WEIGHT: usize = 0;
pub(crate) const HITS: usize = 1;
pub(crate) const OBSERVED: usize = 2;
pub(crate) const SCORE_ROWS: usize = 3;

/// Numbers in the record of one splat–tile pair.
pub(crate) const RECORD_LEN: usize = 16;
