//! Constants of the method that Rust and the shaders share. The shaders repeat them in WGSL; the tests of the GPU
//! backend compare every pair.

/// Splats nearer than this to the camera's plane are not drawn (3DGS; scene units).
pub(crate) const NEAR: f32 = 0.2;

/// Variance added to both screen axes, px² (the low-pass filter of 3DGS).
pub(crate) const LOW_PASS_PX2: f32 = 0.3;

/// Blend weights below this are skipped (3DGS).
pub(crate) const ALPHA_MIN: f32 = 1.0 / 255.0;

/// Largest blend weight of one splat (3DGS).
pub(crate) const ALPHA_MAX: f32 = 0.99;

/// A pixel is full before its transmittance would fall below this (3DGS).
pub(crate) const TRANSMITTANCE_MIN: f32 = 1e-4;

/// Widens the range of pixels of a splat on each side, px, so that rounding cannot lose a pixel on the threshold.
pub(crate) const SLACK_PX: f32 = 0.01;

/// A view observes a splat that it hits before this share of the light is absorbed (PGSR).
pub(crate) const OBSERVED_TRANSMITTANCE: f32 = 0.5;

/// A ray that meets its plane at less than about 0.6° has no usable depth.
pub(crate) const GRAZING: f32 = 0.01;

/// Below this alpha a pixel shows no surface.
pub(crate) const SURFACE_ALPHA: f32 = 0.5;

/// Half the side of SSIM's window, and its side, px (3DGS).
pub(crate) const SSIM_REACH: usize = 5;
pub(crate) const SSIM_TAPS: usize = 2 * SSIM_REACH + 1;

/// SSIM's stabilisers for colours in 0..1 (0.01² and 0.03²).
pub(crate) const SSIM_C1: f32 = 0.000_1;
pub(crate) const SSIM_C2: f32 = 0.000_9;

/// Weights of red, green and blue in luma (Rec. 601).
pub(crate) const LUMA_WEIGHTS: [f32; 3] = [0.299, 0.587, 0.114];

/// Distance of the pixels whose depths give a pixel's normal, px (PGSR). A larger distance halves the noise of the
/// normals, but loses small details.
pub(crate) const NORMAL_REACH: usize = 1;

/// A pixel that returns from the neighbour within this distance is seen by both views, px (θ in CoSurfGS).
pub(crate) const RETURN_MAX_PX: f32 = 1.0;

/// Half the side of a patch that is compared with the neighbour, its side, and its number of pixels. PGSR compares
/// 7 × 7 px; 3 × 3 px gave better surfaces at a third of the work of 5 × 5 (table "Patch size").
pub(crate) const PATCH_REACH: usize = 1;
pub(crate) const PATCH_SIDE: usize = 2 * PATCH_REACH + 1;
pub(crate) const PATCH: usize = PATCH_SIDE * PATCH_SIDE;

/// Keeps the correlation of flat patches finite; luma in 0..1.
pub(crate) const VARIANCES_MIN: f32 = 1e-8;

/// Patches with `1 - NCC²` of at least this show different surfaces (PGSR).
pub(crate) const DISAGREEMENT_MAX: f32 = 0.9;

/// Window weights of SSIM: `exp(-x² / (2 σ²))`, σ = 1.5, normalised to sum 1.
pub(crate) fn ssim_window() -> [f32; SSIM_TAPS] {
    let raw: [f64; SSIM_TAPS] =
        std::array::from_fn(|i| (-(i as f64 - SSIM_REACH as f64).powi(2) / 4.5).exp());
    let sum: f64 = raw.iter().sum();
    raw.map(|w| (w / sum) as f32)
}
