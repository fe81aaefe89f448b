//! The layout of pictures in tiles of 16 × 16 pixels. The pixels of one plane of a tile are contiguous; the planes of a
//! tile follow one another, then comes the next tile. So the blend of a tile uses one contiguous piece of memory. One
//! [`Row`] holds one plane of a row of 16 pixels.

use crate::simd::{Lanes, Row};

/// Side of a tile, px. It equals the number of values in a [`Row`].
pub(crate) const TILE: usize = 16;

#[derive(Clone, Debug)]
pub(crate) struct TileImage {
    size_px: [usize; 2],
    tiles: [usize; 2],
    planes: usize,
    rows: Vec<Row>,
}

impl TileImage {
    /// An empty picture with room for `padded_pixels` pixels (see [`padded_pixels`]) in up to `planes` planes.
    pub(crate) fn with_capacity(padded_pixels: usize, planes: usize) -> Self {
        Self {
            size_px: [0, 0],
            tiles: [0, 0],
            planes,
            rows: Vec::with_capacity(padded_pixels * planes / TILE),
        }
    }

    /// A picture from values in the layout of [`TileImage`].
    #[cfg(feature = "gpu")]
    pub(crate) fn from_values(size_px: [u32; 2], planes: usize, values: &[f32]) -> Self {
        let mut image = Self::with_capacity(padded_pixels(size_px), planes);
        image.reshape(size_px, planes);
        for (row, values) in image.rows.iter_mut().zip(values.as_chunks().0) {
            row.0 = *values;
        }
        image
    }

    /// Sets the size and the number of planes. Old values remain, so every pass that calls this must overwrite all
    /// rows.
    pub(crate) fn reshape(&mut self, size_px: [u32; 2], planes: usize) {
        self.size_px = size_px.map(|side| side as usize);
        self.tiles = Self::tiles_of(size_px);
        self.planes = planes;
        self.rows.resize(self.tiles[0] * self.tiles[1] * planes * TILE, Row::ZERO);
    }

    /// Number of tiles across and down.
    pub(crate) fn tiles_of(size_px: [u32; 2]) -> [usize; 2] {
        size_px.map(|side| (side as usize).div_ceil(TILE))
    }

    pub(crate) fn size_px(&self) -> [usize; 2] {
        self.size_px
    }

    pub(crate) fn tiles(&self) -> [usize; 2] {
        self.tiles
    }

    pub(crate) fn planes(&self) -> usize {
        self.planes
    }

    /// Number of [`Row`]s of one tile in all planes.
    pub(crate) fn rows_per_tile(&self) -> usize {
        self.planes * TILE
    }

    pub(crate) fn tile(&self, tile: usize) -> &[Row] {
        &self.rows[tile * self.rows_per_tile()..][..self.rows_per_tile()]
    }

    pub(crate) fn rows_mut(&mut self) -> &mut [Row] {
        &mut self.rows
    }

    /// The 16 pixels of `plane` in picture row `y` and tile column `tile_x`.
    pub(crate) fn row(&self, plane: usize, y: usize, tile_x: usize) -> &Row {
        let tile = y / TILE * self.tiles[0] + tile_x;
        &self.rows[(tile * self.planes + plane) * TILE + y % TILE]
    }

    pub(crate) fn value(&self, plane: usize, x: usize, y: usize) -> f32 {
        self.row(plane, y, x / TILE).0[x % TILE]
    }

    #[cfg(test)]
    pub(crate) fn set_value(&mut self, plane: usize, x: usize, y: usize, value: f32) {
        let tile = y / TILE * self.tiles[0] + x / TILE;
        self.rows[(tile * self.planes + plane) * TILE + y % TILE].0[x % TILE] = value;
    }
}

/// Number of pixels of a picture whose sides are rounded up to whole tiles.
pub(crate) fn padded_pixels(size_px: [u32; 2]) -> usize {
    size_px.iter().map(|side| (*side as usize).div_ceil(TILE) * TILE).product()
}

/// Horizontal positions, px, of the pixel centres in the `part`-th vector of a row whose first pixel begins at
/// `origin_x`.
#[inline(always)]
pub(crate) fn centers<L: Lanes>(origin_x: f32, part: usize) -> L {
    const OFFSETS: [f32; TILE] =
        [0.5, 1.5, 2.5, 3.5, 4.5, 5.5, 6.5, 7.5, 8.5, 9.5, 10.5, 11.5, 12.5, 13.5, 14.5, 15.5];
    L::load(&OFFSETS[part * L::N..]) + L::splat(origin_x)
}

/// Number of zeros at each end of a line in a plane of the surface losses. Such a plane holds one number for each
/// pixel, for example its depth. Because of these zeros, SIMD loads may reach beyond the edges of the picture. There is
/// also a line of zeros above and one below the picture.
pub(crate) const PLANE_MARGIN: usize = TILE;

/// Length of a line in a plane of the surface losses, with the zeros at both ends, for a picture of this width, px.
pub(crate) fn plane_stride(width: usize) -> usize {
    width.div_ceil(TILE) * TILE + 2 * PLANE_MARGIN
}

/// Numbers in a plane of the surface losses, margins of zeros included, for pictures up to `size_px`.
pub(crate) fn plane_len(size_px: [u32; 2]) -> usize {
    plane_stride(size_px[0] as usize) * (size_px[1] as usize + 2)
}
