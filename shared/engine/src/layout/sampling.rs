//! Chooses the pixels that a step compares with the neighbouring view, one in each square cell. A seed of the step
//! determines them, so every backend compares the same pixels. On a graphics card `samples.wgsl` draws them.

/// Draws the sampled pixel, `[x, y]`, of the cell whose upper left pixel is `(left, top)`. `cell` is the side of the
/// cell, px, a power of two; `draw` is the seed of the step. The sampled pixel may lie outside the picture.
pub(crate) fn sampled_pixel(cell: usize, draw: u64, left: usize, top: usize) -> [usize; 2] {
    let random = mixed(draw ^ ((top as u64) << 32 | left as u64));
    let mask = cell - 1;
    [left + (random as usize & mask), top + ((random >> 32) as usize & mask)]
}

/// Number of cells of a picture; the side of a cell is a power of two.
#[cfg(feature = "gpu")]
pub(crate) fn cells(size_px: [u32; 2], cell_px: u32) -> usize {
    assert!(cell_px.is_power_of_two(), "a cell of {cell_px} px");
    size_px.map(|side| side.div_ceil(cell_px) as usize).iter().product()
}

/// Mixes all bits of a number: the finaliser of SplitMix64.
fn mixed(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}
