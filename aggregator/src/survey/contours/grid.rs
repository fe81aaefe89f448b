//! Heights, averaged over square cells of pixels.
//!
//! What it knows nothing about: contours.

use cosurf_scene::SceneError;
use glam::DVec2;

use crate::survey::tiles::Tiles;

/// Largest side of a grid, cells: 100 MB of memory if both sides are as long.
const SIDE_MAX: u32 = 4096;

/// Mean heights of cells, metres; NaN where less than half of a cell has a height.
pub(super) struct Grid {
    /// Width and height, cells.
    pub(super) size: [usize; 2],
    /// Row by row.
    pub(super) heights: Vec<f32>,
    cell_px: u32,
}

impl Grid {
    /// Averages heights over cells of at least `cell_px` pixels (at least 1).
    pub(super) fn of(heights: &mut Tiles<f32>, size_px: [u32; 2], cell_px: u32) -> Result<Self, SceneError> {
        let longest = size_px[0].max(size_px[1]);
        let cell_px = cell_px.max(longest.div_ceil(SIDE_MAX)).min(longest);
        let size = size_px.map(|side| side.div_ceil(cell_px) as usize);
        let mut sums = vec![(0.0f32, 0u32); size[0] * size[1]];
        // Means of heights relative to the first one keep their millimetres in an `f32`.
        let mut base = None;
        for tile in 0..heights.len() {
            let (window, values) = (heights.window(tile), heights.read(tile)?);
            for (i, height) in values.iter().enumerate().filter(|(_, height)| !height.is_nan()) {
                let (x, y) = (i as u32 % window.size[0], i as u32 / window.size[0]);
                let [column, row] =
                    [(window.at[0] + x) / cell_px, (window.at[1] + y) / cell_px].map(|of| of as usize);
                let sum = &mut sums[row * size[0] + column];
                *sum = (sum.0 + height - *base.get_or_insert(*height), sum.1 + 1);
            }
        }
        let most = cell_px * cell_px;
        let mean = |(sum, count): (f32, u32)| if 2 * count < most { f32::NAN } else { sum / count as f32 };
        let base = base.unwrap_or(0.0);
        Ok(Self { size, heights: sums.into_iter().map(|sum| base + mean(sum)).collect(), cell_px })
    }

    /// Position in the map, px, of a position in the grid, in cells from the centre of the first one.
    pub(super) fn px(&self, at: DVec2) -> DVec2 {
        (at + 0.5) * f64::from(self.cell_px)
    }
}
