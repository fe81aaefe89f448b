//! Divides the views among agents by cells of the ground. [`Division`] lists the ways to divide.
//!
//! The default is recursive bisection. The bounding box of the views' footprint centres is cut across its longer side,
//! in proportion to the agents on each side, until each agent has one cell. All cells then have equally many views,
//! give or take one. The alternatives are a grid of equal cells (CoSurfGS) and hand-drawn polygons.
//!
//! The views of one cell alone show too little of the ground at its border. With a margin, each agent therefore also
//! gets views of other cells that look just beyond the border of its own cell.
//!
//! What it knows nothing about: missions, devices and training. Cells are numbers, and views are positions on a map.
//!
//! Where to start reading: [`partition`]; then [`cosurf_scene::footprint`], which finds where a view looks, and
//! [`cosurf_scene::outline`], the border of a cell.

mod drawn;
mod view;

use glam::DVec2;
use serde::{Deserialize, Serialize};

use cosurf_contract::counted;
use cosurf_scene::Outline;

pub use drawn::{DrawnCell, read_cells};
pub(crate) use view::AssignedView;

/// Width of the margin around each cell, as a share of the cell's size, unless another is given.
pub const DEFAULT_MARGIN: f64 = 0.2;

/// How the ground is divided. Without edge aggregators, the root counts as a single edge aggregator.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Division {
    /// Rectangles with equally many views each, give or take one.
    Evenly {
        /// Number of cells of each edge aggregator.
        agents: usize,
    },
    /// Equal rectangles within the rectangle of each edge aggregator, row by row.
    Grid {
        /// Number of columns.
        columns: usize,
        /// Number of rows.
        rows: usize,
    },
    /// One polygon for each cell, in the order of edge aggregators. A view outside all polygons goes to the nearest
    /// one.
    Polygons(
        /// The corners of each polygon in map coordinates.
        Vec<Vec<[f64; 2]>>,
    ),
}

impl Division {
    /// Number of agents of each edge aggregator. `edges` is the number of edge aggregators, at least 1.
    pub(crate) fn agents(&self, edges: usize) -> usize {
        match self {
            Self::Evenly { agents } => *agents,
            Self::Grid { columns, rows } => columns * rows,
            Self::Polygons(polygons) => polygons.len().div_ceil(edges),
        }
    }
}

/// The views of one agent, and the agent's area on the map.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Cell {
    /// Indices of the cell's views, ascending. After [`partition`], they index the centres given to it. In the plan of
    /// a mission, they index the views of the dataset.
    pub(crate) views: Vec<usize>,
    /// Views of other cells that look at the margin of this cell, as indices like those of `views`, ascending.
    pub(crate) guests: Vec<usize>,
    /// The area of the cell on the map.
    pub(crate) outline: Outline,
}

impl Cell {
    /// A cell without guests.
    pub(crate) fn new(views: Vec<usize>, outline: Outline) -> Self {
        Self { views, guests: Vec::new(), outline }
    }

    /// Distance from a map position to the cell, world units; 0 inside.
    fn distance(&self, at: DVec2) -> f64 {
        at.distance(self.outline.nearest(at))
    }
}

/// Why views cannot be divided.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PartitionError {
    /// There are no agents.
    #[error("a mission needs at least one agent: pass --agents 1 or more")]
    NoAgents,
    /// An agent would have no view.
    #[error("{agents} agents cannot share {}: pass --agents {views} or fewer", counted(*views, "training view"))]
    TooFewViews {
        /// Number of agents.
        agents: usize,
        /// Number of training views.
        views: usize,
    },
    /// There are no training views.
    #[error("there is no view to train on: add photographs or hold fewer out (--eval-every)")]
    NoViews,
    /// No view looks at a cell.
    #[error(
        "no training view looks at cell {cell} of {cells}: make cells larger, or leave --grid and --cells out"
    )]
    EmptyCell {
        /// Number of the cell, from 1.
        cell: usize,
        /// Number of cells.
        cells: usize,
    },
    /// A polygon is not valid.
    #[error("cell {cell} is not a polygon: it needs at least three corners with finite coordinates")]
    NoPolygon {
        /// Number of the cell, from 1.
        cell: usize,
    },
    /// The edge aggregators would have different numbers of polygons.
    #[error("{} cannot be shared by {edges} edges: draw the same number for each", counted(*cells, "cell"))]
    UnevenEdges {
        /// Number of polygons.
        cells: usize,
        /// Number of edge aggregators.
        edges: usize,
    },
}

/// Divides the ground into one cell for each agent: first among the edge aggregators, then among the agents of each
/// edge by `division`. `edges` is the number of edge aggregators, at least 1. `centers` are the centres of the views'
/// footprints and must be finite. The cells are in the order of edges. The same centres always give the same cells.
pub(crate) fn partition(
    centers: &[DVec2],
    edges: usize,
    division: &Division,
) -> Result<Vec<Cell>, PartitionError> {
    match (edges * division.agents(edges), centers.len()) {
        (0, _) => return Err(PartitionError::NoAgents),
        (_, 0) => return Err(PartitionError::NoViews),
        (agents, views) if agents > views => return Err(PartitionError::TooFewViews { agents, views }),
        _ => {}
    }
    let all = Plot { views: (0..centers.len()).collect(), bounds: bounding_box(centers.iter().copied()) };
    let mut rectangles = Vec::with_capacity(edges);
    match division {
        Division::Evenly { agents } => {
            divide(all, edges, centers, &mut rectangles);
            let mut plots = Vec::with_capacity(edges * agents);
            rectangles.into_iter().for_each(|rectangle| divide(rectangle, *agents, centers, &mut plots));
            Ok(plots.into_iter().map(Plot::cell).collect())
        }
        Division::Grid { columns, rows } => {
            divide(all, edges, centers, &mut rectangles);
            let grids = rectangles.iter().flat_map(|plot| grid(plot.bounds, *columns, *rows));
            assign(grids.collect(), centers)
        }
        Division::Polygons(polygons) if !polygons.len().is_multiple_of(edges) => {
            Err(PartitionError::UnevenEdges { cells: polygons.len(), edges })
        }
        Division::Polygons(polygons) => {
            let outline = |(i, polygon): (usize, &Vec<[f64; 2]>)| {
                Outline::polygon(polygon).ok_or(PartitionError::NoPolygon { cell: i + 1 })
            };
            assign(polygons.iter().enumerate().map(outline).collect::<Result<_, _>>()?, centers)
        }
    }
}

/// Sets the guests of each cell. A view of another cell is a guest if the centre of its footprint lies in the cell
/// after the cell is grown by `margin`, a share of the cell's size. A margin of 0 gives no guests.
pub(crate) fn invite(cells: &mut [Cell], centers: &[DVec2], margin: f64) {
    for cell in cells {
        let near = |view: &usize| margin > 0.0 && cell.outline.reaches(centers[*view], margin);
        let others = (0..centers.len()).filter(|view| cell.views.binary_search(view).is_err());
        cell.guests = others.filter(near).collect();
    }
}

/// Index of the cell that contains a position or, outside all cells, of the nearest one. Of equally near cells, the
/// first is returned. There must be at least one cell.
pub(crate) fn nearest_cell(cells: &[Cell], at: DVec2) -> usize {
    let distance = |i: &usize| cells[*i].distance(at);
    let nearest = (0..cells.len()).min_by(|a, b| distance(a).total_cmp(&distance(b)));
    nearest.unwrap_or(0)
}

/// Makes a cell of each outline, and gives each view to the nearest cell. Fails if a cell gets no view.
fn assign(outlines: Vec<Outline>, centers: &[DVec2]) -> Result<Vec<Cell>, PartitionError> {
    let mut cells: Vec<Cell> = outlines.into_iter().map(|outline| Cell::new(Vec::new(), outline)).collect();
    for (view, center) in centers.iter().enumerate() {
        let cell = nearest_cell(&cells, *center);
        cells[cell].views.push(view);
    }
    match cells.iter().position(|cell| cell.views.is_empty()) {
        Some(empty) => Err(PartitionError::EmptyCell { cell: empty + 1, cells: cells.len() }),
        None => Ok(cells),
    }
}

/// Divides a rectangle into equal ones, row by row from its lower side.
fn grid([low, high]: [DVec2; 2], columns: usize, rows: usize) -> Vec<Outline> {
    let counts = DVec2::new(columns as f64, rows as f64);
    let corner = |x: usize, y: usize| low + (high - low) * DVec2::new(x as f64, y as f64) / counts;
    let places = (0..rows).flat_map(|y| (0..columns).map(move |x| (x, y)));
    places.map(|(x, y)| Outline::rectangle([corner(x, y), corner(x + 1, y + 1)])).collect()
}

/// A rectangle that is still to be cut, and the views in it.
struct Plot {
    views: Vec<usize>,
    bounds: [DVec2; 2],
}

impl Plot {
    fn cell(self) -> Cell {
        Cell::new(self.views, Outline::rectangle(self.bounds))
    }
}

/// Cuts `plot` into `agents` plots with equally many views, give or take one, and appends these to `plots`. At each
/// cut, the plots on the side of lower coordinates come first. `agents` is 1 to the number of views.
fn divide(mut plot: Plot, agents: usize, centers: &[DVec2], plots: &mut Vec<Plot>) {
    if agents == 1 {
        plot.views.sort_unstable();
        plots.push(plot);
        return;
    }
    let [low, high] = bounding_box(plot.views.iter().map(|&view| centers[view]));
    let along = usize::from((high - low).y > (high - low).x);
    let key = |view: usize| (centers[view][along], centers[view][1 - along]);
    plot.views.sort_unstable_by(|&a, &b| {
        key(a).0.total_cmp(&key(b).0).then(key(a).1.total_cmp(&key(b).1)).then(a.cmp(&b))
    });
    let lower_agents = agents / 2;
    let upper = plot.views.split_off(share(plot.views.len(), agents, lower_agents));
    let cut = match (plot.views.last(), upper.first()) {
        (Some(&below), Some(&above)) => (key(below).0 + key(above).0) / 2.0,
        _ => unreachable!("{agents} agents share {} views", centers.len()),
    };
    let mut bounds = [plot.bounds; 2];
    bounds[0][1][along] = cut;
    bounds[1][0][along] = cut;
    divide(Plot { views: plot.views, bounds: bounds[0] }, lower_agents, centers, plots);
    divide(Plot { views: upper, bounds: bounds[1] }, agents - lower_agents, centers, plots);
}

/// Number of views for the first `some` of `agents` agents, when all agents get equally many of `views`. If this
/// leaves a remainder of n views, each of the last n agents gets one of them.
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

    fn bisect(centers: &[DVec2], edges: usize, agents: usize) -> Result<Vec<Cell>, PartitionError> {
        partition(centers, edges, &Division::Evenly { agents })
    }

    fn bounds(cell: &Cell) -> [DVec2; 2] {
        cell.outline.bounds()
    }

    /// Pseudo-random centres in a rectangle of 300 × 100 m.
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
        let hull = |cells: &[Cell]| bounding_box(cells.iter().flat_map(bounds));
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
                let low = bounds(cell)[0].max(bounds(other)[0]);
                let high = bounds(cell)[1].min(bounds(other)[1]);
                assert!(low.x >= high.x || low.y >= high.y, "{cell:?} overlaps {other:?}");
            }
        }
    }

    #[test]
    fn guests_are_the_views_of_others_just_beyond_the_border() {
        let centers: Vec<DVec2> = (0..20).map(|i| DVec2::new(f64::from(i) * 10.0, 0.0)).collect();
        let mut cells = bisect(&centers, 1, 2).unwrap();
        invite(&mut cells, &centers, 0.2); // cells of 95 m, so a margin of 19 m
        assert_eq!((&cells[0].guests[..], &cells[1].guests[..]), (&[10, 11][..], &[8, 9][..]));
        invite(&mut cells, &centers, 0.0);
        assert!(cells.iter().all(|cell| cell.guests.is_empty() && cell.views.len() == 10));
    }

    #[test]
    fn the_longer_side_is_cut() {
        for cell in bisect(&scattered(100, 5), 1, 3).unwrap() {
            let [low, high] = bounds(&cell);
            let size = high - low;
            assert!(size.x < 150.0 && size.y > 90.0, "300 × 100 m in 3 is cut across x: {size}");
        }
    }

    #[test]
    fn the_same_centers_give_the_same_cells_even_if_centers_coincide() {
        let mut centers = scattered(20, 9);
        centers.extend(vec![DVec2::new(1.0, 1.0); 20]);
        assert_eq!(bisect(&centers, 1, 5), bisect(&centers, 1, 5));
        let same = bisect(&[DVec2::ZERO; 6], 1, 3).unwrap();
        assert!(same.iter().all(|cell| cell.views.len() == 2), "{same:?}");
    }

    #[test]
    fn too_few_agents_or_views_are_refused_in_one_line() {
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
        assert_eq!(bounds(&cells[0])[1].x, 15.0);
        for (x, cell) in [(-99.0, 0), (14.0, 0), (16.0, 1), (500.0, 1)] {
            assert_eq!(nearest_cell(&cells, DVec2::new(x, 5.0)), cell, "at {x}");
        }
    }

    #[test]
    fn a_grid_has_cells_of_one_size_in_the_rectangle_of_each_edge() {
        let centers = scattered(300, 6);
        let cells = partition(&centers, 2, &Division::Grid { columns: 2, rows: 3 }).unwrap();
        assert_eq!(cells.len(), 12);
        for (i, cell) in cells.iter().enumerate() {
            let (first, its) = (bounds(&cells[i / 6 * 6]), bounds(cell));
            assert!((its[1] - its[0]).abs_diff_eq(first[1] - first[0], 1e-9), "cell {i}");
            assert!(cell.views.iter().all(|view| cell.distance(centers[*view]) == 0.0), "cell {i}");
        }
        assert!(
            bounds(&cells[1])[0].x > bounds(&cells[0])[0].x
                && bounds(&cells[2])[0].y > bounds(&cells[0])[0].y
        );
        let mut all: Vec<usize> = cells.into_iter().flat_map(|cell| cell.views).collect();
        all.sort_unstable();
        assert_eq!(all, (0..300).collect::<Vec<_>>());
    }

    #[test]
    fn polygons_have_the_views_inside_and_the_nearest_of_the_others() {
        let centers: Vec<DVec2> = (0..20).map(|i| DVec2::new(f64::from(i) * 10.0, 0.0)).collect();
        let triangle = |x: f64| vec![[x, -5.0], [x + 60.0, -5.0], [x + 30.0, 5.0]];
        let polygons = Division::Polygons(vec![triangle(100.0), triangle(0.0)]);
        let mut cells = partition(&centers, 1, &polygons).unwrap();
        assert_eq!(cells[1].views, (0..8).collect::<Vec<_>>());
        assert_eq!(cells[0].views, (8..20).collect::<Vec<_>>(), "views outside all polygons too");
        invite(&mut cells, &centers, 0.5);
        assert_eq!(cells[1].guests, [8, 9]);
        assert_eq!(polygons.agents(2), 1);
    }

    #[test]
    fn invalid_cells_are_refused_in_one_line() {
        let centers = scattered(30, 1);
        let refused = |edges, division| partition(&centers, edges, &division).unwrap_err().to_string();
        let square = |x: f64| vec![[x, 0.0], [x + 100.0, 0.0], [x + 100.0, 100.0], [x, 100.0]];
        let error = refused(1, Division::Grid { columns: 9, rows: 3 });
        assert!(error.contains("no training view looks at cell"), "{error}");
        let error = refused(1, Division::Polygons(vec![square(0.0), vec![[0.0, 0.0]; 2]]));
        assert!(error.contains("cell 2 is not a polygon"), "{error}");
        let error = refused(2, Division::Polygons(vec![square(0.0), square(100.0), square(200.0)]));
        assert!(error.contains("3 cells cannot be shared by 2 edges"), "{error}");
        assert_eq!(refused(1, Division::Polygons(Vec::new())), PartitionError::NoAgents.to_string());
    }
}
