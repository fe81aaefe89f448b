//! Marching squares: finds where lines of equal height cross the squares between four neighbouring cells, and joins the
//! pieces.
//!
//! What it knows nothing about: files.

use std::collections::HashMap;

use glam::DVec2;

use crate::survey::grid::Grid;

/// Lines with fewer points are left out: bumps of a single cell.
const POINTS_LEAST: usize = 6;

/// A line of equal height.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Line {
    /// Its height, as a multiple of the difference between contours.
    pub(super) level: i64,
    /// Its points in the map, px; the first is also the last if the line is closed.
    pub(super) points_px: Vec<DVec2>,
}

/// A side of a square: twice the index of its western or northern cell, plus one if the side goes south.
type Side = u64;

/// The lines at all multiples of `step_m`, lowest first. A line ends where heights are missing.
pub(super) fn trace(grid: &Grid, step_m: f64) -> Vec<Line> {
    let mut pieces: Vec<(i64, [Side; 2])> = Vec::new();
    let [width, height] = grid.size;
    for y in 0..height.saturating_sub(1) {
        for x in 0..width.saturating_sub(1) {
            add_pieces(grid, step_m, y * width + x, &mut pieces);
        }
    }
    pieces.sort_by_key(|(level, _)| *level); // stable, so that the lines do not depend on chance
    let levels = pieces.chunk_by(|a, b| a.0 == b.0);
    let mut lines = Vec::new();
    for level in levels {
        for sides in joined(level) {
            if sides.len() >= POINTS_LEAST {
                let height = (level[0].0 as f64 * step_m) as f32;
                let points_px = sides.iter().map(|side| crossing(grid, *side, height)).collect();
                lines.push(Line { level: level[0].0, points_px });
            }
        }
    }
    lines
}

/// Adds the pieces of lines that cross the square whose north-western cell is `first`.
fn add_pieces(grid: &Grid, step_m: f64, first: usize, pieces: &mut Vec<(i64, [Side; 2])>) {
    let width = grid.size[0];
    // Clockwise from the north-west.
    let corners = [first, first + 1, first + width + 1, first + width].map(|cell| grid.heights[cell]);
    if corners.iter().any(|height| height.is_nan()) {
        return;
    }
    let cell = first as u64;
    let sides = [2 * cell, 2 * (cell + 1) + 1, 2 * (cell + width as u64), 2 * cell + 1];
    let [low, high] =
        [f32::min, f32::max].map(|of: fn(f32, f32) -> f32| corners.into_iter().fold(corners[0], of));
    let level_of = |height: f32| (f64::from(height) / step_m).floor() as i64;
    for level in level_of(low)..=level_of(high) {
        let height = (level as f64 * step_m) as f32;
        let is_above = corners.map(|corner| corner >= height);
        let crossed: Vec<usize> = (0..4).filter(|side| is_above[*side] != is_above[(side + 1) % 4]).collect();
        match crossed[..] {
            [a, b] => pieces.push((level, [sides[a], sides[b]])),
            [_, _, _, _] => {
                // A saddle: the middle decides which corners are joined.
                let middle = corners.iter().sum::<f32>() / 4.0 >= height;
                let pairs = if middle == is_above[0] { [[0, 1], [2, 3]] } else { [[3, 0], [1, 2]] };
                pieces.extend(pairs.map(|[a, b]| (level, [sides[a], sides[b]])));
            }
            _ => {}
        }
    }
}

/// Joins pieces of one level to lines, as the sides that they cross. At each side at most two pieces meet.
fn joined(pieces: &[(i64, [Side; 2])]) -> Vec<Vec<Side>> {
    let mut at: HashMap<Side, [Option<usize>; 2]> = HashMap::new();
    for (piece, (_, sides)) in pieces.iter().enumerate() {
        for side in sides {
            let slots = at.entry(*side).or_default();
            slots[usize::from(slots[0].is_some())] = Some(piece);
        }
    }
    let mut used = vec![false; pieces.len()];
    let follow = |from: Side, used: &mut Vec<bool>| {
        let mut line = vec![from];
        let mut side = from;
        while let Some(piece) = at[&side].into_iter().flatten().find(|piece| !used[*piece]) {
            used[piece] = true;
            let [a, b] = pieces[piece].1;
            side = if a == side { b } else { a };
            line.push(side);
        }
        line
    };
    let mut lines = Vec::new();
    // First from the ends of open lines, then around closed ones.
    for open in [true, false] {
        for (piece, (_, sides)) in pieces.iter().enumerate() {
            let start = sides.iter().find(|side| !open || at[*side][1].is_none());
            if let (false, Some(start)) = (used[piece], start) {
                lines.push(follow(*start, &mut used));
            }
        }
    }
    lines
}

/// Where a height crosses a side, px of the map.
fn crossing(grid: &Grid, side: Side, height: f32) -> DVec2 {
    let (cell, is_south) = ((side / 2) as usize, side % 2 == 1);
    let next = cell + if is_south { grid.size[0] } else { 1 };
    let [a, b] = [cell, next].map(|cell| f64::from(grid.heights[cell]));
    let share = ((f64::from(height) - a) / (b - a)).clamp(0.0, 1.0);
    let at = DVec2::new((cell % grid.size[0]) as f64, (cell / grid.size[0]) as f64);
    grid.px(at + if is_south { DVec2::Y } else { DVec2::X } * share)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::survey::tiles::Tiles;

    /// The grid of a map of 40 × 40 px whose pixels have these heights.
    fn grid(height: impl Fn(f32, f32) -> f32) -> Grid {
        let folder = tempfile::tempdir().unwrap();
        let mut tiles = Tiles::new(folder.path(), [40, 40], 64).unwrap();
        let values: Vec<f32> =
            (0..1600).map(|i| height((i % 40) as f32 + 0.5, (i / 40) as f32 + 0.5)).collect();
        tiles.write(0, &values).unwrap();
        Grid::of(&mut tiles, 1, 1 << 30).unwrap()
    }

    #[test]
    fn contours_of_a_cone_are_closed_circles() {
        // 2 m lower for each 8 px from the middle.
        let lines = trace(&grid(|x, y| 10.0 - (x - 20.0).hypot(y - 20.0) / 4.0), 2.0);
        let closed: Vec<&Line> =
            lines.iter().filter(|line| line.points_px.first() == line.points_px.last()).collect();
        assert_eq!(closed.iter().map(|line| line.level).collect::<Vec<_>>(), [3, 4]);
        for (line, radius) in closed.iter().zip([16.0, 8.0]) {
            for point in &line.points_px {
                assert!((point.distance(DVec2::splat(20.0)) - radius).abs() < 0.1, "{point}");
            }
        }
    }

    #[test]
    fn contours_of_a_slope_are_straight_and_end_where_heights_are_missing() {
        let lines = trace(&grid(|x, y| if y > 30.0 { f32::NAN } else { 100.0 + 0.1 * x }), 1.0);
        assert_eq!(lines.iter().map(|line| line.level).collect::<Vec<_>>(), [101, 102, 103]);
        for (line, x) in lines.iter().zip([10.0, 20.0, 30.0]) {
            assert_eq!(line.points_px.len(), 30);
            let [first, last] = [line.points_px[0], line.points_px[29]];
            assert!((first.y - last.y).abs() == 29.0, "{first} {last}");
            assert!(line.points_px.iter().all(|point| (point.x - x).abs() < 0.01), "{line:?}");
        }
    }

    #[test]
    fn every_piece_of_a_saddle_belongs_to_one_line() {
        let lines = trace(&grid(|x, y| 5.0 + 0.01 * (x - 20.0) * (y - 20.0)), 1.0);
        let of_middle: Vec<&Line> = lines.iter().filter(|line| line.level == 5).collect();
        assert_eq!(of_middle.len(), 2, "{of_middle:?}");
    }
}
