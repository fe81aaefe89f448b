//! Pictures in tiles: 16 × 16 pixels of a plane lie together, then the next plane of the same tile,
//! then the next tile. A tile's blend touches one stretch of memory; a row of a tile is one [`Row`].

use super::simd::Row;

/// Side of a tile, pixels. One row of a tile is one group of lanes.
pub(crate) const TILE: usize = 16;

#[derive(Clone, Debug)]
pub(crate) struct TileImage {
    size_px: [usize; 2],
    tiles: [usize; 2],
    planes: usize,
    rows: Vec<Row>,
}

impl TileImage {
    /// Room for pictures of `pixels_capacity` (see [`padded_pixels`]) with up to `planes` planes.
    pub(crate) fn with_capacity(padded_pixels: usize, planes: usize) -> Self {
        Self {
            size_px: [0, 0],
            tiles: [0, 0],
            planes,
            rows: Vec::with_capacity(padded_pixels * planes / TILE),
        }
    }

    /// A picture whose values lie as they do here, plane by plane in each tile.
    #[cfg(feature = "gpu")]
    pub(crate) fn from_values(size_px: [u32; 2], planes: usize, values: &[f32]) -> Self {
        let mut image = Self::with_capacity(padded_pixels(size_px), planes);
        image.reshape(size_px, planes);
        for (row, values) in image.rows.iter_mut().zip(values.as_chunks().0) {
            row.0 = *values;
        }
        image
    }

    /// Lays the image out for a size and a number of planes. Old content is left as it is: every pass
    /// that calls this writes each row.
    pub(crate) fn reshape(&mut self, size_px: [u32; 2], planes: usize) {
        self.size_px = size_px.map(|side| side as usize);
        self.tiles = self.size_px.map(|side| side.div_ceil(TILE));
        self.planes = planes;
        self.rows.resize(self.tiles[0] * self.tiles[1] * planes * TILE, Row::ZERO);
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

    /// Rows of one tile, all planes.
    pub(crate) fn rows_per_tile(&self) -> usize {
        self.planes * TILE
    }

    pub(crate) fn tile(&self, tile: usize) -> &[Row] {
        &self.rows[tile * self.rows_per_tile()..][..self.rows_per_tile()]
    }

    pub(crate) fn rows_mut(&mut self) -> &mut [Row] {
        &mut self.rows
    }

    /// The row of `plane` at height `y` in the `tile_x`-th tile from the left.
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

/// Pixels of a picture whose sides are rounded up to whole tiles.
pub(crate) fn padded_pixels(size_px: [u32; 2]) -> usize {
    size_px.iter().map(|side| (*side as usize).div_ceil(TILE) * TILE).product()
}
