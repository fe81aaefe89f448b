//! The rendering that the surface losses compare, and its division into bands of one row of tiles.

use rayon::prelude::*;

use super::plane::Plane;
use crate::layout::tiles::{TILE, TileImage};
use crate::layout::view::ViewParams;
use crate::simd::Row;

/// A rendering with its camera, its depth, and the luma of the photograph.
#[derive(Clone, Copy)]
pub(super) struct Shown<'a> {
    pub(super) image: &'a TileImage,
    pub(super) view: &'a ViewParams,
    pub(super) depth: &'a Plane,
    pub(super) luma: &'a Plane,
}

impl Shown<'_> {
    /// Pixel rows in the `band`-th row of tiles.
    pub(super) fn rows(&self, band: usize) -> std::ops::Range<usize> {
        band * TILE..((band + 1) * TILE).min(self.image.size_px()[1])
    }
}

/// Index of one row of a tile in a band's slice of gradient rows: tile column `tile_x`, image plane `plane`, picture
/// row `y`.
pub(super) fn band_row(image: &TileImage, plane: usize, y: usize, tile_x: usize) -> usize {
    tile_x * image.rows_per_tile() + plane * TILE + y % TILE
}

/// The bands: for each row of tiles, its index and its gradient rows.
pub(super) fn bands<'a>(
    image: &TileImage,
    gradient: &'a mut TileImage,
) -> impl IndexedParallelIterator<Item = (usize, &'a mut [Row])> {
    let band_rows = image.tiles()[0] * image.rows_per_tile();
    gradient.rows_mut().par_chunks_exact_mut(band_rows).enumerate()
}
