//! Cuts a mesh into charts: connected pieces that lie flat on a picture, seen along one of the three axes.
//!
//! Each triangle is seen along the axis that its normal is closest to, so none is shortened to less than 58 % (1/√3).
//! Pieces end at a grid, so that they fit into rows. Of triangles that lie on each other in a piece, all but one leave it.
//!
//! What it knows nothing about: colours; where charts lie on the picture.
//!
//! Where to start reading: [`charts`].

use cosurf_scene::Mesh;
use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::raster::each_texel;

/// Texels around a chart, so that neither filters nor JPEG blend it with its neighbours.
const BORDER: u32 = 2;
/// Distance of the grid's lines, texels.
const GRID: f64 = 256.0;
/// A texel is within a triangle, not on its edge, if all corners weigh at least this much.
const WITHIN: f64 = 1e-3;

/// A piece of a mesh on a picture of its own.
#[derive(Clone, Debug)]
pub(super) struct Chart {
    /// Indices of its triangles.
    pub(super) triangles: Vec<u32>,
    /// Width and height with the border, texels.
    pub(super) size: [u32; 2],
    /// The axis that it is seen along: 0, 1 or 2.
    axis: usize,
    /// The world's lower left corner, in texels from the mesh's origin, without the border.
    low: DVec2,
}

impl Chart {
    /// A chart of some triangles, at least one, with the smallest size.
    fn of(mesh: &Mesh, triangles: Vec<u32>, texel_m: f64) -> Self {
        let axis = side(mesh, triangles[0]) / 2;
        let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        for corner in triangles.iter().flat_map(|triangle| mesh.corners(*triangle as usize)) {
            let at = flat(corner.as_dvec3(), axis) / texel_m;
            (low, high) = (low.min(at), high.max(at));
        }
        let low = low.floor();
        let size = (high - low).ceil().max(DVec2::ONE).to_array().map(|side| side as u32);
        Self { triangles, size: size.map(|side| side.saturating_add(2 * BORDER)), axis, low }
    }

    /// Where a position of the mesh lies on the chart, texels.
    pub(super) fn texels(&self, position: DVec3, texel_m: f64) -> DVec2 {
        flat(position, self.axis) / texel_m - self.low + f64::from(BORDER)
    }

    /// The corners of a triangle on the chart, texels.
    pub(super) fn corners(&self, mesh: &Mesh, triangle: u32, texel_m: f64) -> [DVec2; 3] {
        mesh.corners(triangle as usize).map(|corner| self.texels(corner.as_dvec3(), texel_m))
    }

    /// Number of texels, with the border.
    pub(super) fn texel_count(&self) -> u64 {
        u64::from(self.size[0]) * u64::from(self.size[1])
    }
}

/// Cuts a mesh in the world into charts with texels of `texel_m`; `None` if they have more texels than `texels_max`.
pub(super) fn charts(mesh: &Mesh, texel_m: f64, texels_max: u64) -> Option<Vec<Chart>> {
    let pieces = pieces(mesh, texel_m);
    let whole: Vec<Chart> =
        pieces.into_par_iter().map(|triangles| Chart::of(mesh, triangles, texel_m)).collect();
    let count = |charts: &[Chart]| charts.iter().map(Chart::texel_count).fold(0, u64::saturating_add);
    if count(&whole) > texels_max {
        return None; // before any texel is looked at
    }
    let split = |chart: Chart| {
        let (kept, left) = without_overlaps(mesh, &chart, texel_m);
        if left.is_empty() {
            return vec![chart];
        }
        let alone = left.into_iter().map(|triangle| vec![triangle]);
        std::iter::once(kept).chain(alone).map(|triangles| Chart::of(mesh, triangles, texel_m)).collect()
    };
    let charts: Vec<Chart> = whole.into_par_iter().flat_map_iter(split).collect();
    (count(&charts) <= texels_max).then_some(charts)
}

/// The connected triangles that are seen along one axis from one side, within one cell of the grid. In the order of their
/// first triangles.
fn pieces(mesh: &Mesh, texel_m: f64) -> Vec<Vec<u32>> {
    let place = |triangle: u32| {
        let side = side(mesh, triangle);
        let [a, b, c] = mesh.corners(triangle as usize).map(|corner| corner.as_dvec3());
        let cell = (flat((a + b + c) / 3.0, side / 2) / (GRID * texel_m)).floor();
        (side, cell.to_array().map(|of| of as i64))
    };
    let places: Vec<_> = (0..mesh.triangles.len() as u32).into_par_iter().map(place).collect();
    let mut edges: Vec<([u32; 2], u32)> = Vec::with_capacity(3 * mesh.triangles.len());
    for (triangle, [a, b, c]) in mesh.triangles.iter().enumerate() {
        let edge = |a: &u32, b: &u32| ([*a.min(b), *a.max(b)], triangle as u32);
        edges.extend([edge(a, b), edge(b, c), edge(c, a)]);
    }
    edges.par_sort_unstable();
    let mut firsts: Vec<u32> = (0..mesh.triangles.len() as u32).collect();
    for pair in edges.windows(2) {
        let [(edge, a), (other, b)] = [pair[0], pair[1]];
        if edge == other && places[a as usize] == places[b as usize] {
            let (a, b) = (first(&mut firsts, a), first(&mut firsts, b));
            firsts[a.max(b) as usize] = a.min(b);
        }
    }
    let mut pieces: Vec<Vec<u32>> = Vec::new();
    let mut piece_of = vec![0; firsts.len()];
    for triangle in 0..firsts.len() as u32 {
        let first = first(&mut firsts, triangle);
        if first == triangle {
            piece_of[triangle as usize] = pieces.len();
            pieces.push(Vec::new());
        }
        pieces[piece_of[first as usize]].push(triangle);
    }
    pieces
}

/// The first triangle of the piece that has a triangle. Shortens the way there.
fn first(firsts: &mut [u32], mut triangle: u32) -> u32 {
    while firsts[triangle as usize] != triangle {
        firsts[triangle as usize] = firsts[firsts[triangle as usize] as usize];
        triangle = firsts[triangle as usize];
    }
    triangle
}

/// The triangles of a chart that lie beside each other, and those that lie on one of them.
fn without_overlaps(mesh: &Mesh, chart: &Chart, texel_m: f64) -> (Vec<u32>, Vec<u32>) {
    let width = chart.size[0] as usize;
    let mut is_taken = vec![false; width * chart.size[1] as usize];
    let mut own = Vec::new();
    chart.triangles.iter().partition(|triangle| {
        own.clear();
        each_texel(chart.corners(mesh, **triangle, texel_m), |[x, y], weights| {
            if weights.min_element() > WITHIN {
                own.push(y * width + x);
            }
        });
        let is_free = own.iter().all(|texel| !is_taken[*texel]);
        if is_free {
            own.iter().for_each(|texel| is_taken[*texel] = true);
        }
        is_free
    })
}

/// The side that a triangle is seen from: twice the axis that its normal is closest to, and one more if it points backwards.
fn side(mesh: &Mesh, triangle: u32) -> usize {
    let [a, b, c] = mesh.corners(triangle as usize).map(|corner| corner.as_dvec3());
    let normal = (b - a).cross(c - a);
    let axis = normal.abs().max_position();
    2 * axis + usize::from(normal[axis] < 0.0)
}

/// A position seen along an axis.
fn flat(position: DVec3, axis: usize) -> DVec2 {
    DVec2::new(position[(axis + 1) % 3], position[(axis + 2) % 3])
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    /// A strip of ten steps that winds up around the z axis, once and a quarter.
    fn winding_stair() -> Mesh {
        let at = |i: usize, radius: f64| {
            let angle = (i as f64) * std::f64::consts::PI / 4.0;
            [radius * angle.cos(), radius * angle.sin(), 0.2 * i as f64].map(|of| of as f32)
        };
        Mesh {
            positions: (0..11).flat_map(|i| [at(i, 4.0), at(i, 9.0)]).collect(),
            triangles: (0..10).flat_map(|i| [[0, 1, 3], [0, 3, 2]].map(|t| t.map(|v| v + 2 * i))).collect(),
            ..Mesh::default()
        }
    }

    #[test]
    fn pieces_are_connected_and_look_to_one_side() {
        // A floor of two triangles, a wall that joins it, and a triangle beside both.
        let mesh = Mesh {
            positions: [
                [0, 0, 0],
                [4, 0, 0],
                [4, 4, 0],
                [0, 4, 0],
                [4, 4, 3],
                [9, 0, 0],
                [9, 1, 0],
                [8, 0, 0],
            ]
            .map(|at| at.map(|of| of as f32))
            .to_vec(),
            triangles: vec![[0, 1, 2], [2, 1, 4], [5, 6, 7], [0, 2, 3]],
            ..Mesh::default()
        };
        let charts = charts(&mesh, 0.5, 10_000).unwrap();
        let found: Vec<_> = charts.iter().map(|chart| (chart.triangles.clone(), chart.size)).collect();
        assert_eq!(found, [(vec![0, 3], [12, 12]), (vec![1], [12, 10]), (vec![2], [6, 6])]);
        assert!(super::charts(&mesh, 0.5, 12 * 12 + 12 * 10 + 35).is_none());
        assert_eq!(super::charts(&mesh, 0.005, 10_000_000).unwrap().len(), 4, "the grid divides the floor");
    }

    #[test]
    fn triangles_that_lie_on_each_other_have_charts_of_their_own() {
        let mesh = winding_stair();
        let charts = charts(&mesh, 0.1, 1_000_000).unwrap();
        assert!(charts.len() > 1, "one winding hides the other");
        let mut all: Vec<u32> = charts.iter().flat_map(|chart| chart.triangles.clone()).collect();
        all.sort_unstable();
        assert_eq!(all, (0..20).collect::<Vec<_>>());
        assert!(charts.iter().all(|chart| without_overlaps(&mesh, chart, 0.1).1.is_empty()));
    }
}
