//! Chooses the pixels that a step compares with the neighbouring view, one in each square cell. A seed of the step
//! determines them, so every backend compares the same pixels.

#[cfg(feature = "gpu")]
use super::tiles::TILE;

/// Draws the sampled pixel, `[x, y]`, of the cell whose upper left pixel is `(left, top)`. `cell` is the side of the
/// cell, px, a power of two; `draw` is the seed of the step. The sampled pixel may lie outside the picture.
pub(crate) fn sampled_pixel(cell: usize, draw: u64, left: usize, top: usize) -> [usize; 2] {
    let random = mixed(draw ^ ((top as u64) << 32 | left as u64));
    let mask = cell - 1;
    [left + (random as usize & mask), top + ((random >> 32) as usize & mask)]
}

/// The sampled pixels of all cells, in rows of cells. Each entry holds x in the low 16 bits and y in the high 16 bits.
#[cfg(feature = "gpu")]
pub(crate) fn sampled_pixels(size_px: [u32; 2], cell_px: u32, draw: u64) -> Vec<u32> {
    let ([width, height], cell) = (size_px.map(|side| side as usize), cell_px as usize);
    assert!(cell.is_power_of_two() && cell <= TILE, "a cell of {cell} px");
    let tops = (0..height).step_by(cell);
    let cells = tops.flat_map(|top| (0..width).step_by(cell).map(move |left| (left, top)));
    cells
        .map(|(left, top)| {
            let [x, y] = sampled_pixel(cell, draw, left, top);
            (x | y << 16) as u32
        })
        .collect()
}

/// Mixes all bits of a number: the finaliser of SplitMix64.
fn mixed(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}
