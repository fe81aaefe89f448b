//! Divides the ground of a merged model into tiles for those who receive it. The tiles are larger than those of the
//! distillation.

use std::collections::BTreeMap;

use cosurf_engine::compress::longest_side;
use cosurf_link::Model;

use super::tiles::{Map, vertical};

/// Number of cells of the map along the longest side of the model. Fine enough where a few splats lie far off.
const CELLS_ACROSS: f64 = 4096.0;

/// The ground of a model, divided into tiles. A tile is the same rectangle in another revision of the model, unless it
/// got so many splats that it is divided.
pub(crate) struct Ground {
    map: Map,
    /// The tile of each cell of the map.
    tile_of: BTreeMap<[i64; 2], usize>,
    tiles: usize,
}

impl Ground {
    /// Divides the ground into tiles with at most `most` splats each.
    pub(crate) fn of(model: &Model, most: usize) -> Self {
        let side = longest_side(&model.splats) / CELLS_ACROSS;
        let mut map = Map::new(vertical(model.cameras.iter()), side);
        map.add(&model.splats.means);
        let tiles = map.tiles(most);
        let place = |cell: [i64; 2]| tiles.iter().position(|tile| tile.contains(map.center(cell)));
        let tile_of = map.cells().filter_map(|cell| Some((cell, place(cell)?))).collect();
        Self { tile_of, tiles: tiles.len(), map }
    }

    /// Number of tiles.
    pub(crate) fn tiles(&self) -> usize {
        self.tiles
    }

    /// The tile above or below which a splat lies; `None` if the model has no splats near there.
    pub(crate) fn tile(&self, mean: [f32; 3]) -> Option<usize> {
        self.tile_of.get(&self.map.cell(mean)).copied()
    }
}
