//! The triangles of marching cubes, computed instead of read from a table. The signs at the corners of a cell
//! tell which of its edges the surface crosses. A walk around the faces of the cell gives these edges in
//! order.
//!
//! A face whose corners alternate in sign is ambiguous. On such a face, the surface always separates the two
//! inner corners (those inside the surface) from each other. So both cells at the face agree, and there are
//! no cracks (Nielson and Hamann 1991): every edge of the mesh has two triangles, except where the data end.

use std::sync::OnceLock;

/// The corner at which each edge of a cell starts. Edge `4 * axis + k` starts at corner
/// `EDGE_STARTS[4 * axis + k]` and runs upwards along `axis`: 0 for x, 1 for y, 2 for z. Corner `c` lies at
/// `(c & 1, c >> 1 & 1, c >> 2)`.
pub(super) const EDGE_STARTS: [usize; 12] = [0, 2, 4, 6, 0, 1, 4, 5, 0, 1, 2, 3];

/// Corners of each face, counter-clockwise as seen from outside the cell.
const FACES: [[usize; 4]; 6] =
    [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];

/// The triangles of a cell. Every vertex of a triangle lies on an edge of the cell.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Case {
    /// For each triangle, the numbers of the edges of its vertices, counter-clockwise as seen from outside
    /// the surface.
    pub(super) triangles: Vec<[u8; 3]>,
}

/// The triangles for every combination of signs. Bit `c` of the index is set if corner `c` is inside the
/// surface.
pub(super) fn cases() -> &'static [Case; 256] {
    static CASES: OnceLock<[Case; 256]> = OnceLock::new();
    CASES.get_or_init(|| std::array::from_fn(|inside| Case { triangles: triangles_of(inside) }))
}

fn triangles_of(inside: usize) -> Vec<[u8; 3]> {
    let mut next = next_edges(inside);
    let mut triangles = Vec::new();
    for first in 0..12 {
        let mut ring = Vec::new();
        let mut edge = first;
        while let Some(after) = next[edge].take() {
            ring.push(edge as u8);
            edge = after;
        }
        for i in 2..ring.len() {
            triangles.push([ring[0], ring[i - 1], ring[i]]);
        }
    }
    triangles
}

/// Maps each edge that the surface crosses to the next such edge on a walk around the surface; `None` for all
/// other edges. A crossed edge belongs to two faces, and the surface enters one of them at this edge. The
/// next edge is where the surface leaves that face.
fn next_edges(inside: usize) -> [Option<usize>; 12] {
    let is_inside = |corner: usize| inside >> corner & 1 == 1;
    let mut next = [None; 12];
    for face in FACES {
        for k in 0..4 {
            let (a, b) = (face[k], face[(k + 1) % 4]);
            if is_inside(a) || !is_inside(b) {
                continue;
            }
            // A run of inner corners starts at `b`. The surface leaves the face after the last corner of the
            // run.
            let run = (1..4).take_while(|step| is_inside(face[(k + step) % 4])).count();
            let (last, beyond) = (face[(k + run) % 4], face[(k + run + 1) % 4]);
            next[edge_between(a, b)] = Some(edge_between(last, beyond));
        }
    }
    next
}

fn edge_between(a: usize, b: usize) -> usize {
    let axis = (a ^ b).trailing_zeros() as usize;
    let start = a & b;
    (4 * axis..4 * axis + 4).find(|&edge| EDGE_STARTS[edge] == start).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn triangles_use_exactly_the_edges_between_corners_of_different_sign() {
        for (inside, case) in cases().iter().enumerate() {
            for (edge, &start) in EDGE_STARTS.iter().enumerate() {
                let end = start | 1 << (edge / 4);
                let crossed = (inside >> start & 1) != (inside >> end & 1);
                let used = case.triangles.iter().any(|t| t.contains(&(edge as u8)));
                assert_eq!(crossed, used, "case {inside:08b}, edge {edge}");
            }
        }
    }

    #[test]
    fn the_triangle_that_cuts_off_a_single_inner_corner_faces_outwards() {
        // Edges 0, 4 and 8 start at corner 0 and run along x, y and z. This order is counter-clockwise as
        // seen from corner 7.
        let triangle = cases()[1].triangles[0];
        let start = triangle.iter().position(|&edge| edge == 0).map(|i| triangle[(i + 1) % 3]);
        assert_eq!((cases()[1].triangles.len(), start), (1, Some(4)));
    }
}
