//! The order of a splat's numbers in the tables of both backends, which have one row for each number.

use cosurf_scene::splats::sh_coefficients;

/// First row of the mean, xyz.
pub(crate) const MEAN: usize = 0;
/// First row of the quaternion, wxyz.
pub(crate) const QUAT: usize = 3;
/// First row of the log-scales, one for each axis.
pub(crate) const LOG_SCALE: usize = 7;
/// Row of the opacity logit.
pub(crate) const OPACITY: usize = 10;
/// First row of the SH coefficients, in the order `[coefficient, rgb]`.
pub(crate) const SH: usize = 11;

/// Number of rows of the SH coefficients.
pub(crate) const fn sh_rows(sh_degree: u32) -> usize {
    3 * sh_coefficients(sh_degree)
}

/// Number of rows of all parameters.
pub(crate) const fn parameter_rows(sh_degree: u32) -> usize {
    SH + sh_rows(sh_degree)
}

/// First row of ∂L/∂rgb in a table of gradients; rgb is the colour that the view sees. The rows before it are those of
/// mean, quaternion, log-scales and opacity logit, as in the parameters. There are no SH rows: the gradients of SH
/// coefficients are ∂L/∂rgb times the basis, and the optimiser computes them when it needs them.
pub(crate) const GRADIENT_RGB: usize = SH;
/// Number of rows of a gradient.
pub(crate) const GRADIENT_ROWS: usize = GRADIENT_RGB + 3;

/// Row of the densification statistics: the sum over views of the norm of ∂L/∂mean on the screen, with screen positions
/// in units of half the picture (the measure of 3DGS).
pub(crate) const STAT_SCREEN_GRADIENT: usize = 0;
/// Row of the densification statistics: the number of views that saw the splat.
pub(crate) const STAT_VIEWS: usize = 1;
/// Row of the densification statistics: like [`STAT_SCREEN_GRADIENT`], but each axis of ∂L/∂mean is a sum over pixels
/// of absolute values (AbsGS).
pub(crate) const STAT_ABSOLUTE_GRADIENT: usize = 2;
/// Number of rows of the densification statistics.
pub(crate) const STAT_ROWS: usize = 3;

/// Row of the scores: Σ (α T)² over pixels, with the alpha α of the splat and the transmittance T before it.
pub(crate) const SQUARED_WEIGHT: usize = 0;
/// Row of the scores: the number of pixels that the splat was blended into.
pub(crate) const HITS: usize = 1;
/// Row of the scores: the number of views that observed the splat. In the record of one splat–tile pair, it is the
/// number of pixels that the splat was blended into while their transmittance was above one half.
pub(crate) const OBSERVED: usize = 2;
/// Number of rows of the scores.
pub(crate) const SCORE_ROWS: usize = 3;

/// Numbers in the record of one splat–tile pair.
pub(crate) const RECORD_LEN: usize = 16;
