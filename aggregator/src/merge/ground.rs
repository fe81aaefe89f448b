//! Divides the ground of a merged model into tiles for those who receive it. The tiles are larger than those of the
//! distillation.

use std::collections::BTreeMap;
use std::convert::Infallible;

use cosurf_engine::compress::longest_side;
use cosurf_link::Model;
use glam::DVec3;

use super::tiles::{Map, Tile, vertical};

/// Number of cells of the map along the longest side of the model.
const CELLS_ACROSS: f64 = 64.0;

/// The ground of a model, divided into tiles. A tile is the same rectangle in another revision of the model, unless it
/// got so many splats that it is divided.
pub(crate) struct Ground {
    map: Map,
    tiles: Vec<Tile>,
    /// The tiles that each cell of the map touches.
    tiles_of: BTreeMap<[i64; 2], Vec<usize>>,
}

impl Ground {
    /// Divides the ground into tiles with at most `most` splats each.
    pub(crate) fn of(model: &Model, most: usize) -> Self {
        let side = longest_side(&model.splats) / CELLS_ACROSS;
        let mut map = Map::new(vertical(model.cameras.iter()), side);
        map.add(&model.splats.means);
        let inside = |tile: &Tile| {
            let is_inside = |mean: &&[f32; 3]| tile.contains(DVec3::from_array(mean.map(f64::from)));
            Ok::<_, Infallible>(model.splats.means.iter().filter(is_inside).copied().collect())
        };
        let Ok(tiles) = map.tiles(most, inside);
        let mut tiles_of: BTreeMap<[i64; 2], Vec<usize>> = BTreeMap::new();
        for (i, tile) in tiles.iter().enumerate() {
            map.cells_of(tile).for_each(|cell| tiles_of.entry(cell).or_default().push(i));
        }
        Self { map, tiles, tiles_of }
    }

    /// Number of tiles.
    pub(crate) fn tiles(&self) -> usize {
        self.tiles.len()
    }

    /// The tile above or below which a splat lies; `None` if the model has no splats near there.
    pub(crate) fn tile(&self, mean: [f32; 3]) -> Option<usize> {
        let place = DVec3::from_array(mean.map(f64::from));
        let near = self.tiles_of.get(&self.map.cell(mean))?;
        near.iter().copied().find(|tile| self.tiles[*tile].contains(place))
    }
}
