//! Removes triangles where the surface is about flat and of one colour, with the library meshoptimizer (quadric errors of
//! positions and colours, Garland and Heckbert 1998).
//!
//! Pure-Rust ports exist; of 8.9 million triangles of the built-in city, this library keeps 1.2 million within half a voxel,
//! in 13 seconds.
//!
//! What it knows nothing about: tiles and files.

use cosurf_scene::Mesh;
use meshopt::{SimplifyOptions, VertexDataAdapter, simplify_with_attributes_and_locks};

use crate::survey::parts::{renumbered, vertices};

/// A difference of colours, of 1, that weighs as much as the bound on the error: a twelfth is hardly seen.
const COLOR_STEP: f64 = 1.0 / 12.0;

/// How wrong a decimated mesh may be.
#[derive(Clone, Copy, Debug)]
pub(super) struct Bound {
    /// Distance from the surface, units of the mesh, above 0. It is the library's estimate, a root of quadric errors: single
    /// points may be farther away.
    pub(super) error: f64,
}

/// What is left.
pub(super) struct Decimated {
    /// Triangles of vertices of the mesh.
    pub(super) triangles: Vec<[u32; 3]>,
    /// Error that was reached, units of the mesh; at most the bound.
    pub(super) error: f64,
}

/// Decimates some triangles of a mesh. Vertices that are `locked`, as a function of their index, stay.
pub(super) fn decimate(mesh: &Mesh, triangles: &[[u32; 3]], locked: &[bool], bound: Bound) -> Decimated {
    let vertices = vertices(triangles);
    let of = |vertex: &u32| *vertex as usize;
    let positions: Vec<[f32; 3]> = vertices.iter().map(|vertex| mesh.positions[of(vertex)]).collect();
    let color =
        |vertex| mesh.rgb.get(of(vertex)).map_or([0.0; 3], |rgb| rgb.map(|value| f32::from(value) / 255.0));
    let colors: Vec<[f32; 3]> = vertices.iter().map(color).collect();
    let locks: Vec<bool> = vertices.iter().map(|vertex| locked[of(vertex)]).collect();
    let Ok(adapter) = VertexDataAdapter::new(bytemuck::cast_slice(&positions), size_of::<[f32; 3]>(), 0)
    else {
        // Positions are whole by their type, so this does not happen; the triangles themselves are no error.
        return Decimated { triangles: triangles.to_vec(), error: 0.0 };
    };
    let mut error = 0.0;
    let kept = simplify_with_attributes_and_locks(
        renumbered(triangles, &vertices).as_flattened(),
        &adapter,
        colors.as_flattened(),
        &[(bound.error / COLOR_STEP) as f32; 3],
        size_of::<[f32; 3]>(),
        &locks,
        0,
        bound.error as f32,
        SimplifyOptions::ErrorAbsolute,
        Some(&mut error),
    );
    let corners = |corners: &[u32]| [0, 1, 2].map(|k| vertices[corners[k] as usize]);
    Decimated { triangles: kept.chunks_exact(3).map(corners).collect(), error: f64::from(error) }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A flat square of 20 × 20 cells, with a step of 1 in the middle if `is_stepped`.
    fn square(is_stepped: bool) -> Mesh {
        let at = |i: u32| [(i % 21) as f32, (i / 21) as f32];
        let height = |x: f32| if is_stepped && x > 10.0 { 1.0 } else { 0.0 };
        let cells = (0..21 * 20).filter(|i| i % 21 < 20);
        Mesh {
            positions: (0..441).map(|i| [at(i)[0], at(i)[1], height(at(i)[0])]).collect(),
            rgb: (0..441).map(|i| if at(i)[1] < 9.5 { [0; 3] } else { [255; 3] }).collect(),
            triangles: cells.flat_map(|i| [[i, i + 1, i + 22], [i, i + 22, i + 21]]).collect(),
            ..Mesh::default()
        }
    }

    #[test]
    fn steps_and_changes_of_colour_stay_and_the_rest_goes() {
        let bound = Bound { error: 0.01 };
        let of = |mesh: &Mesh, locked: bool| decimate(mesh, &mesh.triangles, &[locked; 441], bound);
        let flat = Mesh { rgb: vec![[9; 3]; 441], ..square(false) };
        assert_eq!(of(&flat, false).triangles.len(), 2);
        assert_eq!(of(&flat, true).triangles.len(), 800, "no vertex may go");
        let found = of(&square(true), false);
        assert!((12..60).contains(&found.triangles.len()), "{}", found.triangles.len());
        assert!(found.error <= 0.01, "{}", found.error);
        let mesh = square(true);
        for corners in &found.triangles {
            let [a, b, c] = corners.map(|vertex| mesh.positions[vertex as usize]);
            // No triangle bridges the step or the border of the colours at another place than the mesh does.
            let spans = |axis: usize, low: f32, high: f32| {
                let of = [a, b, c].map(|p| p[axis]);
                of.iter().any(|v| *v < low) && of.iter().any(|v| *v > high)
            };
            assert!(!spans(0, 10.0, 11.0) && !spans(1, 9.0, 10.0), "{a:?} {b:?} {c:?}");
        }
    }
}
