//! Heights, averaged over square cells of pixels.
//!
//! What it knows nothing about: contours and terrain.

use cosurf_scene::SceneError;
use glam::DVec2;

use super::tiles::Tiles;

/// Share of the memory that a grid, and what is computed with it, may take.
const MEMORY_SHARE: u64 = 8;
/// Bytes per cell of a grid and of what is computed with it: sums, several copies of the heights, a pyramid.
const BYTES_PER_CELL: u64 = 32;

/// Sums of heights are multiples of this, metres: sums of integers do not depend on the order of the tiles.
const STEP_M: f64 = 1.0 / 65_536.0;

/// Heights of cells, metres; NaN where less than half of a cell has a height.
#[derive(Debug)]
pub(super) struct Grid {
    /// Width and height, cells.
    pub(super) size: [usize; 2],
    /// Row by row.
    pub(super) heights: Vec<f32>,
    /// Side of a cell, px.
    pub(super) cell_px: u32,
}

impl Grid {
    /// Averages heights over cells with a side of at least `cell_px` pixels (at least 1), larger ones if `memory_bytes`
    /// allows no more.
    pub(super) fn of(heights: &mut Tiles<f32>, cell_px: u32, memory_bytes: u64) -> Result<Self, SceneError> {
        let mut grid = Self::empty(heights.size_px(), cell_px, memory_bytes);
        grid.average(heights, |_, _| true)?;
        Ok(grid)
    }

    /// The same with the lowest height of each cell.
    pub(super) fn lowest(
        heights: &mut Tiles<f32>,
        cell_px: u32,
        memory_bytes: u64,
    ) -> Result<Self, SceneError> {
        let mut grid = Self::empty(heights.size_px(), cell_px, memory_bytes);
        let mut lowest = vec![(f32::INFINITY, 0u32); grid.heights.len()];
        grid.for_each_pixel(heights, |cell, height| {
            lowest[cell] = (lowest[cell].0.min(height), lowest[cell].1 + 1);
        })?;
        grid.heights =
            lowest.iter().map(|(low, count)| if grid.is_half(*count) { *low } else { f32::NAN }).collect();
        Ok(grid)
    }

    /// Makes each height the mean of those pixels of the cell that `counts`, a function of the cell's index and the pixel's
    /// height, wants.
    pub(super) fn average(
        &mut self,
        heights: &mut Tiles<f32>,
        counts: impl Fn(usize, f32) -> bool,
    ) -> Result<(), SceneError> {
        let mut sums = vec![(0i64, 0u32); self.heights.len()];
        self.for_each_pixel(heights, |cell, height| {
            if counts(cell, height) {
                let sum = sums[cell].0 + (f64::from(height) / STEP_M).round() as i64;
                sums[cell] = (sum, sums[cell].1 + 1);
            }
        })?;
        for (cell, (sum, count)) in sums.into_iter().enumerate() {
            let mean = sum as f64 * STEP_M / f64::from(count);
            self.heights[cell] = if self.is_half(count) { mean as f32 } else { f32::NAN };
        }
        Ok(())
    }

    fn empty(size_px: [u32; 2], cell_px: u32, memory_bytes: u64) -> Self {
        let cell_px = cell_px.max(least_px(size_px, memory_bytes)).min(size_px[0].max(size_px[1]));
        let size = size_px.map(|side| side.div_ceil(cell_px) as usize);
        Self { size, heights: vec![f32::NAN; size[0] * size[1]], cell_px }
    }

    /// Whether a cell has heights in at least half of its pixels if it has them in this number.
    fn is_half(&self, count: u32) -> bool {
        u64::from(count) * 2 >= u64::from(self.cell_px) * u64::from(self.cell_px)
    }

    /// Calls `visit` with the index of the cell and the height of each pixel that has one.
    fn for_each_pixel(
        &self,
        heights: &mut Tiles<f32>,
        mut visit: impl FnMut(usize, f32),
    ) -> Result<(), SceneError> {
        for tile in 0..heights.len() {
            let (window, values) = (heights.window(tile), heights.read(tile)?);
            for (i, height) in values.iter().enumerate().filter(|(_, height)| !height.is_nan()) {
                let px = [window.at[0] + i as u32 % window.size[0], window.at[1] + i as u32 / window.size[0]];
                let [column, row] = px.map(|of| (of / self.cell_px) as usize);
                visit(row * self.size[0] + column, *height);
            }
        }
        Ok(())
    }

    /// Position in the grid, in cells from the centre of the first one, of a position in the map, px.
    pub(super) fn cell(&self, px: DVec2) -> DVec2 {
        px / f64::from(self.cell_px) - 0.5
    }

    /// Position in the map, px, of a position in the grid, in cells from the centre of the first one.
    pub(super) fn px(&self, at: DVec2) -> DVec2 {
        (at + 0.5) * f64::from(self.cell_px)
    }
}

/// The smallest side of cells that the memory allows, px.
fn least_px(size_px: [u32; 2], memory_bytes: u64) -> u32 {
    let cells_max = (memory_bytes / MEMORY_SHARE / BYTES_PER_CELL).max(1);
    let cells = |side: u32| size_px.map(|px| u64::from(px.div_ceil(side))).iter().product::<u64>();
    let about = (f64::from(size_px[0]) * f64::from(size_px[1]) / cells_max as f64).sqrt() as u32;
    // More, because a row and a column of cells may stand out of the map.
    (about.max(1)..).find(|side| cells(*side) <= cells_max).unwrap_or(u32::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_grow_where_memory_is_small() {
        assert_eq!(least_px([1000, 1000], 1 << 30), 1);
        for (size_px, memory_bytes) in [([50_000, 50_000], 1 << 30), ([50_000, 300], 1 << 20), ([1, 1], 0)] {
            let side = least_px(size_px, memory_bytes);
            let cells = u64::from(size_px[0].div_ceil(side)) * u64::from(size_px[1].div_ceil(side));
            assert!(cells * BYTES_PER_CELL <= (memory_bytes / 8).max(32), "{size_px:?}: {side} px");
        }
    }
}
