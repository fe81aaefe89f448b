//! What the tiles of a merge are made from: the splats of all models in files, and their cameras in memory.

use std::ops::Range;

use cosurf_engine::Neighbours;
use cosurf_engine::compress::longest_side;
use cosurf_link::Model;
use cosurf_scene::{Camera, SparsePoint, Splats};

use super::error::MergeError;
use super::observed::Observed;
use super::pages::{Area, Pages, place};
use super::tiles::{Map, Tile, vertical};
use crate::scratch::Scratch;

/// Limit on the splats of a model from which the median depths of its views are estimated.
const PROBES: usize = 2000;
/// Number of cells of the map along the longest side of the first model. With more cells, the map of a large site takes
/// much memory; with fewer, more splats are read to find the tiles.
const CELLS_ACROSS: f64 = 8.0;

/// All models of a merge.
#[derive(Debug)]
pub(super) struct Site<'a> {
    /// The splats that stay after compression.
    pub(super) joined: Pages,
    /// The pages of each model's joined splats.
    pub(super) joined_pages: Vec<Range<usize>>,
    /// All splats of all models.
    pub(super) models: Pages,
    /// The pages of each model.
    pub(super) pages: Vec<Range<usize>>,
    /// The cameras of each model.
    pub(super) cameras: &'a [Vec<Camera>],
    /// The neighbours of each model's cameras.
    pub(super) neighbours: Vec<Neighbours>,
    /// What the cameras of all models observed.
    pub(super) observed: Observed<'a>,
    /// Where the joined splats lie.
    map: Option<Map>,
    /// Where the files are.
    pub(super) scratch: Scratch,
}

impl<'a> Site<'a> {
    /// A site without models. Those to come have these cameras, and at most this degree of spherical harmonics.
    pub(super) fn new(
        scratch: Scratch,
        cameras: &'a [Vec<Camera>],
        observed: Observed<'a>,
        sh_degree: u32,
    ) -> Result<Self, MergeError> {
        Ok(Self {
            joined: Pages::new(&scratch, sh_degree)?,
            joined_pages: Vec::new(),
            models: Pages::new(&scratch, sh_degree)?,
            pages: Vec::new(),
            cameras,
            neighbours: Vec::new(),
            observed,
            map: None,
            scratch,
        })
    }

    /// Adds the next model, of which `kept` stays after compression.
    pub(super) fn add(&mut self, model: &Model, kept: &Splats) -> Result<(), MergeError> {
        let Model { splats, cameras } = model;
        let area = Area::of(&splats.means);
        self.pages.push(self.models.append(splats, &area)?);
        self.neighbours.push(Neighbours::find(cameras, &probes(splats)));
        self.joined_pages.push(self.joined.append(kept, &area)?);
        let cell = || longest_side(splats) / CELLS_ACROSS;
        let new = || Map::new(vertical(self.cameras.iter().flatten()), cell());
        self.map.get_or_insert_with(new).add(&kept.means);
        Ok(())
    }

    /// Divides the ground into tiles with at most `most` splats each.
    pub(super) fn tiles(&self, most: usize) -> Result<Vec<Tile>, MergeError> {
        let means = |tile: &Tile| -> Result<_, MergeError> { Ok(self.own(tile)?.means) };
        self.map.as_ref().map_or(Ok(Vec::new()), |map| map.tiles(most, means))
    }

    /// The joined splats of a tile.
    pub(super) fn own(&self, tile: &Tile) -> Result<Splats, MergeError> {
        let mut own = Splats::with_capacity(tile.splats, self.joined.sh_degree());
        self.joined.read(
            self.joined.all(),
            |bounds| tile.touches(bounds.low, bounds.high),
            |at, _| tile.contains(at),
            &mut own,
        )?;
        Ok(own)
    }
}

/// Positions of at most [`PROBES`] splats, evenly chosen, as sparse points. The points do not list the views that see
/// them.
fn probes(splats: &Splats) -> Vec<SparsePoint> {
    let step = splats.len().div_ceil(PROBES).max(1);
    let point = |mean: &[f32; 3]| SparsePoint { position: place(*mean), rgb: [0; 3], views: Vec::new() };
    splats.means.iter().step_by(step).map(point).collect()
}
