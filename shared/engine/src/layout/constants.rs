//! Constants of rendering and losses that Rust and the shaders share. The shaders repeat them in WGSL; a test of the
//! GPU backend compares every pair.

/// Splats at this depth or less are not drawn (3DGS). Depth is along the optical axis, world units.
pub(crate) const NEAR: f32 = 0.2;

/// Variance that is added to a projected splat along both screen axes, px² (the low-pass filter of 3DGS).
pub(crate) const LOW_PASS_PX2: f32 = 0.3;

/// A splat is not blended into pixels where its alpha is below this (3DGS).
pub(crate) const ALPHA_MIN: f32 = 1.0 / 255.0;

/// Largest alpha of one splat at a pixel; a higher alpha is lowered to this (3DGS).
pub(crate) const ALPHA_MAX: f32 = 0.99;

/// A pixel is full at the first splat that would lower its transmittance below this; neither that splat nor any behind
/// it is blended (3DGS).
pub(crate) const TRANSMITTANCE_MIN: f32 = 1e-4;

/// Margin on both sides of the range of pixels that a splat covers, px. Without it, rounding could lose a pixel at the
/// end of the range.
pub(crate) const SLACK_PX: f32 = 0.01;

/// A view observes a splat if the splat is blended into a pixel while the pixel's transmittance is above this (PGSR).
pub(crate) const OBSERVED_TRANSMITTANCE: f32 = 0.5;

/// Smallest `-(n · r)` of a surface with unit normal `n` at which a pixel has a depth; `r` is the ray of the pixel,
/// scaled to z = 1. Rays that meet the surface at less than about 0.6° have no depth.
pub(crate) const GRAZING: f32 = 0.01;

/// A pixel whose blended alpha is below this shows no surface, so it has no depth.
pub(crate) const SURFACE_ALPHA: f32 = 0.5;

/// Number of pixels of SSIM's window on each side of its centre (3DGS).
pub(crate) const SSIM_REACH: usize = 5;
/// Side of SSIM's window, px.
pub(crate) const SSIM_TAPS: usize = 2 * SSIM_REACH + 1;

/// SSIM's first constant, 0.01², for colours in 0..=1. It keeps the quotient of means finite.
pub(crate) const SSIM_C1: f32 = 0.000_1;
/// SSIM's second constant, 0.03², for colours in 0..=1. It keeps the quotient of variances finite.
pub(crate) const SSIM_C2: f32 = 0.000_9;

/// Weights of red, green and blue in luma (Rec. 601).
pub(crate) const LUMA_WEIGHTS: [f32; 3] = [0.299, 0.587, 0.114];
/// Stands for the luma of a masked pixel. Below all lumas.
pub(crate) const MASKED_LUMA: f32 = -1.0;

/// Distance, px, between a pixel and the four pixels whose depths give its normal (PGSR). Twice the distance would
/// halve the noise of the normals, but lose small details.
pub(crate) const NORMAL_REACH: usize = 1;

/// A sampled pixel is compared with the neighbouring view only if its reprojection error (see
/// [`crate::backend::MultiviewWeights::reprojection`]) is below this, px (θ in CoSurfGS). A larger error means that the
/// two views see different points.
pub(crate) const RETURN_MAX_PX: f32 = 1.0;

/// Largest number of pixels of a patch: [`crate::backend::PatchSide::Px7`] squared.
pub(crate) const PATCH_MAX: usize = 49;

/// Added to the product of the variances of two patches, with luma in 0..=1, so that the correlation of flat patches
/// stays finite.
pub(crate) const VARIANCES_MIN: f32 = 1e-8;

/// Patches with `1 - NCC²` of at least this show different surfaces (PGSR). NCC is the normalised cross-correlation.
pub(crate) const DISAGREEMENT_MAX: f32 = 0.9;

/// Weights of SSIM's window along one axis: `exp(-x² / (2 σ²))` at a distance of `x` px, with σ = 1.5 px, normalised to
/// sum 1.
pub(crate) fn ssim_window() -> [f32; SSIM_TAPS] {
    let raw: [f64; SSIM_TAPS] =
        std::array::from_fn(|i| libm::exp(-(i as f64 - SSIM_REACH as f64).powi(2) / 4.5));
    let sum: f64 = raw.iter().sum();
    raw.map(|w| (w / sum) as f32)
}
