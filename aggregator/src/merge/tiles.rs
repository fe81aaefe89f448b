//! Divides the ground into tiles. A tile has so few splats that it can be distilled by itself.
//!
//! The ground is halved, across the longer side, until no part has too many splats. All borders are at multiples of
//! powers of two, so a tile is the same rectangle whatever lies elsewhere.

use std::collections::BTreeMap;

use cosurf_scene::Camera;
use glam::DVec3;
use serde::{Deserialize, Serialize};

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
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
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
        let cell_log2 = libm::log2(side.max(f64::MIN_POSITIVE)).floor() as i32;
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
        let side = libm::exp2(f64::from(self.cell_log2));
        horizontal(self.vertical, mean).map(|at| (f64::from(at) / side).floor() as i64)
    }

    /// The cells that a tile touches, as far as they have splats.
    pub(super) fn cells_of(&self, tile: &Tile) -> impl Iterator<Item = [i64; 2]> {
        let side = libm::exp2(f64::from(self.cell_log2));
        let touches = move |cell: &[i64; 2]| {
            (0..2).all(|axis| {
                let at = cell[axis] as f64 * side;
                tile.low[axis] < at + side && at < tile.high[axis]
            })
        };
        self.cells.keys().copied().filter(touches)
    }

    /// Divides the ground into tiles with at most `most` splats each, unless they lie in almost one place. `means` gives
    /// the splats of a cell that has more than `most`, and may give others too.
    pub(super) fn tiles<E>(
        &self,
        most: usize,
        means: impl Fn(&Tile) -> Result<Vec<[f32; 3]>, E>,
    ) -> Result<Vec<Tile>, E> {
        let side = libm::exp2(f64::from(self.cell_log2));
        let all: Vec<([i64; 2], usize)> = self.cells.iter().map(|(cell, count)| (*cell, *count)).collect();
        let reach = all.iter().flat_map(|(cell, _)| cell).map(|at| at.unsigned_abs() + 1).max().unwrap_or(1);
        let half = reach.next_power_of_two() as f64 * side;
        let smallest = 2.0 * half * libm::exp2(f64::from(-HALVINGS_MAX));
        let tile = |low: [f64; 2], sides: [f64; 2], splats: usize| {
            let high = [low[0] + sides[0], low[1] + sides[1]];
            Tile { vertical: self.vertical, low, high, splats }
        };
        let mut tiles = Vec::new();
        let mut left = vec![([-half; 2], [2.0 * half; 2], Content::Cells(all))];
        while let Some((low, sides, mut content)) = left.pop() {
            let whole = tile(low, sides, content.splats());
            if whole.splats <= most || sides[0].max(sides[1]) <= smallest {
                tiles.push(whole);
                continue;
            }
            if sides == [side; 2] {
                let inside = |place: &[f64; 2]| whole.contains_at(*place);
                let places =
                    means(&whole)?.into_iter().map(|mean| horizontal(self.vertical, mean.map(f64::from)));
                content = Content::Splats(places.filter(inside).collect());
            }
            let axis = usize::from(sides[1] > sides[0]);
            let (mut halves, mut second) = (sides, low);
            halves[axis] /= 2.0;
            second[axis] += halves[axis];
            let [before, after] = content.divided(axis, second[axis], side);
            left.extend(
                [(second, halves, after), (low, halves, before)]
                    .into_iter()
                    .filter(|(.., its)| its.splats() > 0),
            );
        }
        Ok(tiles)
    }
}

/// What lies on a part of the ground.
enum Content {
    /// Cells, with the number of splats of each.
    Cells(Vec<([i64; 2], usize)>),
    /// Splats: where they lie.
    Splats(Vec<[f64; 2]>),
}

impl Content {
    fn splats(&self) -> usize {
        match self {
            Self::Cells(cells) => cells.iter().map(|(_, count)| count).sum(),
            Self::Splats(places) => places.len(),
        }
    }

    /// What lies before, and what lies after a border across `axis`. Cells have this `side`.
    fn divided(self, axis: usize, border: f64, side: f64) -> [Self; 2] {
        match self {
            Self::Cells(cells) => {
                let is_after = |(cell, _): &([i64; 2], usize)| cell[axis] as f64 * side >= border;
                let (after, before) = cells.into_iter().partition(is_after);
                [before, after].map(Self::Cells)
            }
            Self::Splats(places) => {
                let (after, before) = places.into_iter().partition(|place| place[axis] >= border);
                [before, after].map(Self::Splats)
            }
        }
    }
}

impl Tile {
    /// Whether a world point lies above or below the tile.
    pub(super) fn contains(&self, place: DVec3) -> bool {
        self.contains_at(horizontal(self.vertical, place.to_array()))
    }

    fn contains_at(&self, at: [f64; 2]) -> bool {
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
    #![allow(clippy::unwrap_used)]
    use std::convert::Infallible;

    use super::*;
    use crate::testing::{above, ground};

    fn tiles_of(means: &[[f32; 3]], most: usize) -> Vec<Tile> {
        tiles_with_cells(means, most, 1.0)
    }

    fn tiles_with_cells(means: &[[f32; 3]], most: usize, side: f64) -> Vec<Tile> {
        let mut map = Map::new(2, side);
        map.add(means);
        map.tiles(most, |_| Ok::<_, Infallible>(means.to_vec())).unwrap()
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
    fn splats_in_one_place_are_not_divided() {
        assert_eq!(tiles_of(&[[0.5; 3]; 20], 10)[0].splats, 20);
    }

    #[test]
    fn tiles_do_not_depend_on_the_size_of_the_cells() {
        let means = ground(-37.0, 12.0).means;
        let fine = tiles_with_cells(&means, 20, 0.25);
        assert!(fine.iter().all(|tile| tile.splats <= 20) && fine.len() > 100, "{}", fine.len());
        for side in [1.0, 4.0, 16.0] {
            let coarse = tiles_with_cells(&means, 20, side);
            let differ = coarse.iter().filter(|tile| !fine.contains(tile)).count();
            assert_eq!((differ, coarse.len()), (0, fine.len()), "cells of {side} m");
        }
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
