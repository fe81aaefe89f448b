//! Marching cubes without a table of triangles: walking around the faces of a cell gives the edges that
//! the surface crosses, in order, from the signs at the corners.
//!
//! On a face whose corners alternate in sign, the surface always cuts off the inner corners. So both
//! cells at a face agree and there are no cracks (Nielson and Hamann 1991): every edge of the mesh has
//! two triangles, except where the data end.

use std::sync::OnceLock;

/// Corner `c` of a cell lies at `(c & 1, c >> 1 & 1, c >> 2)`. Edge `4 axis + k` starts at the corner
/// listed here and goes up along the axis.
pub(super) const EDGE_STARTS: [usize; 12] = [0, 2, 4, 6, 0, 1, 4, 5, 0, 1, 2, 3];

/// Corners of each face, counter-clockwise as seen from outside the cell.
const FACES: [[usize; 4]; 6] =
    [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];

/// The triangles of a cell; every vertex lies on an edge of the cell.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Case {
    /// Numbers of edges, counter-clockwise as seen from outside the surface.
    pub(super) triangles: Vec<[u8; 3]>,
}

/// All cases; bit `c` of the index is set if corner `c` is inside.
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

/// For each edge that the surface crosses, the next one on the way around the surface. Each such edge
/// belongs to two faces: the surface enters one of them there, and leaves the other.
fn next_edges(inside: usize) -> [Option<usize>; 12] {
    let is_inside = |corner: usize| inside >> corner & 1 == 1;
    let mut next = [None; 12];
    for face in FACES {
        for k in 0..4 {
            let (a, b) = (face[k], face[(k + 1) % 4]);
            if is_inside(a) || !is_inside(b) {
                continue;
            }
            // A run of inner corners starts at b; the surface leaves the face after the last of them.
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
        // Edges 0, 4, 8 leave corner 0 along x, y, z; counter-clockwise as seen from (1, 1, 1).
        let triangle = cases()[1].triangles[0];
        let start = triangle.iter().position(|&edge| edge == 0).map(|i| triangle[(i + 1) % 3]);
        assert_eq!((cases()[1].triangles.len(), start), (1, Some(4)));
    }
}
