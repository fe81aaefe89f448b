//! Divides the ground into tiles. A tile has so few splats that it can be distilled by itself.
//!
//! The ground is halved, across the longer side, until no part has too many splats. All borders are at multiples of
//! powers of two, so a tile is the same rectangle whatever lies elsewhere.

use std::collections::BTreeMap;

use cosurf_scene::Camera;
use glam::DVec3;

/// A rectangle of the ground is not divided if its sides are less than this share of the whole ground's: 2 to the power
/// of minus this.
const HALVINGS_MAX: i32 = 20;

/// The map of a site: which axes of the world are horizontal, and how many splats lie where.
#[derive(Clone, Debug)]
pub(super) struct Map {
    vertical: usize,
    /// Cells have this side, 2 to this power, world units.
    cell_log2: i32,
    /// Number of splats of each cell. Cells are numbered from the origin.
    cells: BTreeMap<[i64; 2], usize>,
}

/// A rectangle of the ground.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Tile {
    vertical: usize,
    low: [f64; 2],
    high: [f64; 2],
    /// Number of splats.
    pub(super) splats: usize,
}

impl Map {
    /// A map without splats. Its cells are at most `side` wide, world units.
    pub(super) fn new(vertical: usize, side: f64) -> Self {
        let cell_log2 = side.max(f64::MIN_POSITIVE).log2().floor() as i32;
        Self { vertical, cell_log2, cells: BTreeMap::new() }
    }

    /// Counts splats.
    pub(super) fn add(&mut self, means: &[[f32; 3]]) {
        for mean in means {
            *self.cells.entry(self.cell(*mean)).or_default() += 1;
        }
    }

    /// The cell of a splat.
    pub(super) fn cell(&self, mean: [f32; 3]) -> [i64; 2] {
        let side = f64::from(self.cell_log2).exp2();
        horizontal(self.vertical, mean).map(|at| (f64::from(at) / side).floor() as i64)
    }

    /// The cells with splats.
    pub(super) fn cells(&self) -> impl Iterator<Item = [i64; 2]> {
        self.cells.keys().copied()
    }

    /// A point in the middle of a cell.
    pub(super) fn center(&self, cell: [i64; 2]) -> DVec3 {
        let side = f64::from(self.cell_log2).exp2();
        let mut center = DVec3::ZERO;
        for (axis, at) in cell.into_iter().enumerate() {
            center[(self.vertical + 1 + axis) % 3] = (at as f64 + 0.5) * side;
        }
        center
    }

    /// Divides the ground into tiles with at most `most` splats each. A tile that is a single cell may have more.
    pub(super) fn tiles(&self, most: usize) -> Vec<Tile> {
        let side = f64::from(self.cell_log2).exp2();
        let all: Vec<([i64; 2], usize)> = self.cells.iter().map(|(cell, count)| (*cell, *count)).collect();
        let reach = all.iter().flat_map(|(cell, _)| cell).map(|at| at.unsigned_abs() + 1).max().unwrap_or(1);
        let half = reach.next_power_of_two() as i64;
        let mut tiles = Vec::new();
        let mut left = vec![([-half; 2], [2 * half; 2], all)];
        while let Some((low, sides, cells)) = left.pop() {
            let splats = cells.iter().map(|(_, count)| count).sum();
            let is_small = sides[0].max(sides[1]) <= (2 * half) >> HALVINGS_MAX;
            if splats <= most || sides == [1; 2] || is_small {
                let bounds = |at: [i64; 2]| at.map(|at| at as f64 * side);
                let high = [low[0] + sides[0], low[1] + sides[1]];
                tiles.push(Tile { vertical: self.vertical, low: bounds(low), high: bounds(high), splats });
                continue;
            }
            let axis = usize::from(sides[1] > sides[0]);
            let (mut halves, mut second) = (sides, low);
            halves[axis] /= 2;
            second[axis] += halves[axis];
            let (after, before): (Vec<_>, Vec<_>) =
                cells.into_iter().partition(|(cell, _)| cell[axis] >= second[axis]);
            left.extend(
                [(second, halves, after), (low, halves, before)]
                    .into_iter()
                    .filter(|(.., its)| !its.is_empty()),
            );
        }
        tiles
    }
}

impl Tile {
    /// Whether a world point lies above or below the tile.
    pub(super) fn contains(&self, place: DVec3) -> bool {
        let at = horizontal(self.vertical, place.to_array());
        (0..2).all(|axis| self.low[axis] <= at[axis] && at[axis] < self.high[axis])
    }

    /// Whether a point of a box lies above or below the tile.
    pub(super) fn touches(&self, low: DVec3, high: DVec3) -> bool {
        let [low, high] = [low, high].map(|corner| horizontal(self.vertical, corner.to_array()));
        (0..2).all(|axis| self.low[axis] <= high[axis] && low[axis] < self.high[axis])
    }
}

fn horizontal<T: Copy>(vertical: usize, place: [T; 3]) -> [T; 2] {
    [place[(vertical + 1) % 3], place[(vertical + 2) % 3]]
}

/// The axis of the world, 0 to 2, that is nearest to the vertical. The cameras of drones look down on average. On a
/// tie, it is the later axis.
pub(super) fn vertical<'a>(cameras: impl Iterator<Item = &'a Camera>) -> usize {
    let sum: DVec3 = cameras.map(|camera| camera.cam_from_world.forward()).sum();
    let along = sum.abs();
    (0..3).max_by(|a, b| along[*a].total_cmp(&along[*b])).unwrap_or(2)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{above, ground};

    fn tiles_of(means: &[[f32; 3]], most: usize) -> Vec<Tile> {
        let mut map = Map::new(2, 1.0);
        map.add(means);
        map.tiles(most)
    }

    #[test]
    fn every_splat_lies_in_one_tile_and_no_tile_has_too_many() {
        let means = ground(-37.0, 12.0).means;
        let tiles = tiles_of(&means, 150);
        assert!(tiles.len() > means.len() / 150 && tiles.len() < means.len() / 50, "{}", tiles.len());
        assert!(tiles.iter().all(|tile| tile.splats <= 150));
        for tile in &tiles {
            let inside = means.iter().filter(|mean| tile.contains(DVec3::from_array(mean.map(f64::from))));
            assert_eq!(inside.count(), tile.splats);
        }
        assert_eq!(tiles.iter().map(|tile| tile.splats).sum::<usize>(), means.len());
    }

    #[test]
    fn a_tile_stays_the_same_when_ground_far_away_is_added() {
        let west = ground(-37.0, 12.0).means;
        let both = [west.clone(), ground(90.0, 140.0).means].concat();
        let [before, after] = [west, both].map(|means| tiles_of(&means, 150));
        assert!(before.iter().all(|tile| after.contains(tile)));
    }

    #[test]
    fn few_splats_are_one_tile_wherever_the_origin_lies() {
        assert_eq!(tiles_of(&ground(-5.0, 5.0).means, 10_000).len(), 1);
        assert!(tiles_of(&[], 10).iter().all(|tile| tile.splats == 0));
    }

    #[test]
    fn splats_in_one_cell_are_not_divided() {
        assert_eq!(tiles_of(&[[0.5; 3]; 20], 10)[0].splats, 20);
    }

    #[test]
    fn cameras_that_look_down_tell_the_vertical_axis() {
        let mut cameras = vec![above(0.0), above(3.0)];
        assert_eq!(vertical(cameras.iter()), 2);
        for camera in &mut cameras {
            camera.cam_from_world.rotation *= glam::DQuat::from_rotation_x(1.5);
        }
        assert_eq!(vertical(cameras.iter()), 1);
    }

    #[test]
    fn a_box_touches_the_tiles_that_it_overlaps() {
        let tile = tiles_of(&[[0.5, 0.5, 9.0]], 10)[0];
        let touches = |low: f64, high: f64| tile.touches(DVec3::splat(low), DVec3::splat(high));
        assert!(tile.contains(DVec3::new(0.5, -0.5, 99.0)) && touches(0.5, 0.6) && touches(-9.0, 9.0));
        assert!(!touches(1.0, 2.0) && !touches(-3.0, -1.1));
    }
}
