//! Limits of the layout, and counts that several packs share.

/// Version of the body layout.
pub(super) const LAYOUT: u8 = 3;

/// Highest degree of the spherical harmonics.
pub const MAX_SH_DEGREE: u8 = 3;
/// Maximum number of splats in a pack: enough for zstd to compress well, and few enough that a slow radio
/// sends the pack in half a minute.
pub const PACK_SPLATS_MAX: usize = 8192;
/// Maximum compression ratio of a pack; a pack that would exceed it is stored uncompressed. This bounds the
/// memory that a small message can request. Trained models stay far below it.
pub const RATIO_MAX: usize = 8;
/// Base-2 logarithm of the zstd window. A frame that needs a larger window is refused. Every pack of splats
/// fits into it.
pub const WINDOW_LOG: u32 = 19;

/// View-dependent spherical-harmonics coefficients per splat: `3 (sh_degree + 1)² - 3`.
pub const fn sh_rest(sh_degree: u8) -> usize {
    let n = sh_degree as usize + 1;
    3 * n * n - 3
}
