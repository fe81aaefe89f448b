//! Divides views among agents: contiguous cells of the ground with equally many views each.
//!
//! Recursive bisection: the views' footprint centres are cut across the longer side of their
//! bounding box, in proportion to the agents on either side, until each agent has one cell. Ground at a
//! border is seen by too few views of either side alone: with a margin, each agent also gets the views of
//! others that look just beyond its borders.

use glam::DVec2;

/// The views of one agent and the rectangle of ground they stand for.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Cell {
    /// Indices into the centres given to [`bisect`], ascending.
    pub(crate) views: Vec<usize>,
    /// Views of other cells that look at the margin of this one, ascending.
    pub(crate) guests: Vec<usize>,
    /// Lowest and highest map coordinates; the cells of a partition meet only at their borders.
    pub(crate) bounds: [DVec2; 2],
}

impl Cell {
    /// A cell without guests.
    pub(crate) fn new(views: Vec<usize>, bounds: [DVec2; 2]) -> Self {
        Self { views, guests: Vec::new(), bounds }
    }

    /// Distance from a map position to the cell, 0 inside.
    fn distance(&self, at: DVec2) -> f64 {
        at.distance(at.clamp(self.bounds[0], self.bounds[1]))
    }

    /// Whether a map position lies in the cell grown by `margin` of its size on each side.
    fn reaches(&self, at: DVec2, margin: f64) -> bool {
        let [low, high] = self.bounds;
        let grown = (high - low) * margin;
        at.cmpge(low - grown).all() && at.cmple(high + grown).all()
    }
}

/// Why views cannot be divided.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PartitionError {
    /// Nobody to divide among.
    #[error("a mission needs at least one agent: pass --agents 1 or more")]
    NoAgents,
    /// An agent would have no view.
    #[error("{agents} agents cannot share {views} training views: pass --agents {views} or fewer")]
    TooFewViews {
        /// Agents asked for.
        agents: usize,
        /// Views there are.
        views: usize,
    },
    /// There is nothing to train on.
    #[error("there is no view to train on: add photographs or hold fewer out (--eval-every)")]
    NoViews,
}

/// Cuts the ground into one cell per agent, with equally many views each, give or take one: first into `edges`
/// rectangles (at least 1), then each of them into the cells of `agents`, one rectangle's after the other's. The
/// same centres give the same cells. Centres must be finite.
pub(crate) fn bisect(centers: &[DVec2], edges: usize, agents: usize) -> Result<Vec<Cell>, PartitionError> {
    match (edges * agents, centers.len()) {
        (0, _) => return Err(PartitionError::NoAgents),
        (_, 0) => return Err(PartitionError::NoViews),
        (agents, views) if agents > views => return Err(PartitionError::TooFewViews { agents, views }),
        _ => {}
    }
    let all = Cell::new((0..centers.len()).collect(), bounding_box(centers.iter().copied()));
    let mut rectangles = Vec::with_capacity(edges);
    divide(all, edges, centers, &mut rectangles);
    let mut cells = Vec::with_capacity(edges * agents);
    rectangles.into_iter().for_each(|rectangle| divide(rectangle, agents, centers, &mut cells));
    Ok(cells)
}

/// Lets each cell have the views of others whose centres lie within `margin` of its size around it.
pub(crate) fn invite(cells: &mut [Cell], centers: &[DVec2], margin: f64) {
    for cell in cells {
        let near = |view: &usize| margin > 0.0 && cell.reaches(centers[*view], margin);
        let others = (0..centers.len()).filter(|view| cell.views.binary_search(view).is_err());
        cell.guests = others.filter(near).collect();
    }
}

/// The cell that a position belongs to: the one it is in, else the nearest; the first of equals.
/// There must be at least one cell.
pub(crate) fn nearest_cell(cells: &[Cell], at: DVec2) -> usize {
    let distance = |i: &usize| cells[*i].distance(at);
    let nearest = (0..cells.len()).min_by(|a, b| distance(a).total_cmp(&distance(b)));
    nearest.unwrap_or(0)
}

/// Divides `cell` among `agents`, appending their cells from the lower side to the upper.
fn divide(mut cell: Cell, agents: usize, centers: &[DVec2], cells: &mut Vec<Cell>) {
    if agents == 1 {
        cell.views.sort_unstable();
        cells.push(cell);
        return;
    }
    let [low, high] = bounding_box(cell.views.iter().map(|&view| centers[view]));
    let along = usize::from((high - low).y > (high - low).x);
    let key = |view: usize| (centers[view][along], centers[view][1 - along]);
    cell.views.sort_unstable_by(|&a, &b| {
        key(a).0.total_cmp(&key(b).0).then(key(a).1.total_cmp(&key(b).1)).then(a.cmp(&b))
    });
    let lower_agents = agents / 2;
    let upper = cell.views.split_off(share(cell.views.len(), agents, lower_agents));
    let cut = match (cell.views.last(), upper.first()) {
        (Some(&below), Some(&above)) => (key(below).0 + key(above).0) / 2.0,
        _ => unreachable!("{agents} agents share {} views", centers.len()),
    };
    let mut bounds = [cell.bounds; 2];
    bounds[0][1][along] = cut;
    bounds[1][0][along] = cut;
    divide(Cell::new(cell.views, bounds[0]), lower_agents, centers, cells);
    divide(Cell::new(upper, bounds[1]), agents - lower_agents, centers, cells);
}

/// How many of `views`, shared by `agents` as evenly as whole views can be, go to the first `some`
/// of the agents: the odd ones go to the last agents, one each.
fn share(views: usize, agents: usize, some: usize) -> usize {
    let odd_ones = views % agents;
    views / agents * some + odd_ones.saturating_sub(agents - some)
}

fn bounding_box(points: impl Iterator<Item = DVec2>) -> [DVec2; 2] {
    points.fold([DVec2::MAX, DVec2::MIN], |[low, high], p| [low.min(p), high.max(p)])
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    /// Centres scattered by a small generator over 300 × 100 m.
    fn scattered(count: usize, seed: u64) -> Vec<DVec2> {
        let mut state = seed;
        let mut next = || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 33) as f64 / (1u64 << 31) as f64
        };
        (0..count).map(|_| DVec2::new(next() * 300.0, next() * 100.0)).collect()
    }

    #[test]
    fn every_view_goes_to_exactly_one_cell_and_counts_differ_by_one_at_most() {
        for views in [1, 2, 7, 64, 101] {
            for agents in (1..=views.min(9)).chain([views]) {
                let cells = bisect(&scattered(views, 7), 1, agents).unwrap();
                let counts: Vec<usize> = cells.iter().map(|cell| cell.views.len()).collect();
                let spread = counts.iter().max().unwrap() - counts.iter().min().unwrap();
                assert!(cells.len() == agents && spread <= 1, "{views} views: {counts:?}");
                let mut all: Vec<usize> = cells.into_iter().flat_map(|cell| cell.views).collect();
                all.sort_unstable();
                assert_eq!(all, (0..views).collect::<Vec<_>>());
            }
        }
    }

    #[test]
    fn the_cells_of_an_edge_fill_one_rectangle() {
        let centers = scattered(90, 4);
        let cells = bisect(&centers, 3, 2).unwrap();
        let hull = |cells: &[Cell]| bounding_box(cells.iter().flat_map(|cell| cell.bounds));
        let hulls: Vec<[DVec2; 2]> = cells.chunks(2).map(hull).collect();
        assert!(cells.iter().all(|cell| cell.views.len() == 15));
        for (i, [low, high]) in hulls.iter().enumerate() {
            for other in &hulls[..i] {
                let (low, high) = (low.max(other[0]), high.min(other[1]));
                assert!(low.x >= high.x || low.y >= high.y, "{hulls:?}");
            }
        }
        assert_eq!(bisect(&centers, 1, 6).unwrap().len(), 6);
    }

    #[test]
    fn cells_are_contiguous_rectangles_that_meet_only_at_borders() {
        let centers = scattered(90, 3);
        let cells = bisect(&centers, 1, 7).unwrap();
        for (i, cell) in cells.iter().enumerate() {
            for &view in &cell.views {
                assert_eq!(cell.distance(centers[view]), 0.0, "view {view} lies in its cell");
                assert_eq!(nearest_cell(&cells, centers[view]), i, "and in no other");
            }
            for other in &cells[..i] {
                let low = cell.bounds[0].max(other.bounds[0]);
                let high = cell.bounds[1].min(other.bounds[1]);
                assert!(low.x >= high.x || low.y >= high.y, "{cell:?} overlaps {other:?}");
            }
        }
    }

    #[test]
    fn guests_are_the_views_of_others_just_beyond_the_border() {
        let centers: Vec<DVec2> = (0..20).map(|i| DVec2::new(f64::from(i) * 10.0, 0.0)).collect();
        let mut cells = bisect(&centers, 1, 2).unwrap();
        invite(&mut cells, &centers, 0.2); // 95 m, so 19 m
        assert_eq!((&cells[0].guests[..], &cells[1].guests[..]), (&[10, 11][..], &[8, 9][..]));
        invite(&mut cells, &centers, 0.0);
        assert!(cells.iter().all(|cell| cell.guests.is_empty() && cell.views.len() == 10));
    }

    #[test]
    fn the_longer_side_is_cut() {
        for cell in bisect(&scattered(100, 5), 1, 3).unwrap() {
            let size = cell.bounds[1] - cell.bounds[0];
            assert!(size.x < 150.0 && size.y > 90.0, "300 × 100 m in 3 is cut across x: {size}");
        }
    }

    #[test]
    fn the_same_centers_give_the_same_cells_even_where_they_coincide() {
        let mut centers = scattered(20, 9);
        centers.extend(vec![DVec2::new(1.0, 1.0); 20]);
        assert_eq!(bisect(&centers, 1, 5), bisect(&centers, 1, 5));
        let same = bisect(&[DVec2::ZERO; 6], 1, 3).unwrap();
        assert!(same.iter().all(|cell| cell.views.len() == 2), "{same:?}");
    }

    #[test]
    fn what_cannot_be_divided_is_refused_in_one_line() {
        let centers = scattered(3, 1);
        let error = bisect(&centers, 1, 4).unwrap_err();
        assert_eq!(error, PartitionError::TooFewViews { agents: 4, views: 3 });
        assert!(error.to_string().contains("--agents 3") && !error.to_string().contains('\n'));
        assert_eq!(bisect(&centers, 1, 0), Err(PartitionError::NoAgents));
        assert_eq!(bisect(&[], 1, 1), Err(PartitionError::NoViews));
    }

    #[test]
    fn a_held_out_view_goes_to_the_nearest_cell() {
        let centers: Vec<DVec2> = (0..4).map(|i| DVec2::new(f64::from(i) * 10.0, 0.0)).collect();
        let cells = bisect(&centers, 1, 2).unwrap();
        assert_eq!(cells[0].bounds[1].x, 15.0);
        for (x, cell) in [(-99.0, 0), (14.0, 0), (16.0, 1), (500.0, 1)] {
            assert_eq!(nearest_cell(&cells, DVec2::new(x, 5.0)), cell, "at {x}");
        }
    }
}
