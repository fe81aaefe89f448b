//! Limits of the body layout, and the number of spherical-harmonics coefficients.

/// Version of the body layout.
pub(super) const LAYOUT: u8 = 3;

/// Highest degree of the spherical harmonics.
pub const MAX_SH_DEGREE: u8 = 3;
/// Maximum number of splats in a pack. This is enough for zstd to compress well, and few enough for a slow
/// radio to send the pack in half a minute.
pub const PACK_SPLATS_MAX: usize = 8192;
/// Maximum compression ratio of a pack. A pack that would exceed the ratio is stored uncompressed. The
/// limit bounds the memory that a small body can make a receiver allocate. Packs of trained models have far
/// lower ratios.
pub const RATIO_MAX: usize = 8;
/// Base-2 logarithm of the size of the zstd window in bytes. Every pack of splats fits into the window. A
/// zstd frame that needs a larger window is refused.
pub const WINDOW_LOG: u32 = 19;

/// Number of view-dependent spherical-harmonics coefficients of a splat: `3 (sh_degree + 1)² - 3`.
pub const fn sh_rest(sh_degree: u8) -> usize {
    let n = sh_degree as usize + 1;
    3 * n * n - 3
}
