//! Reduces a mesh to a number of triangles, with the library meshoptimizer (quadric errors of positions and colours, Garland
//! and Heckbert 1998). Triangles go first where the surface is about flat and of one colour.
//!
//! What it knows nothing about: how the mesh was made.

use cosurf_scene::Mesh;
use meshopt::{SimplifyOptions, VertexDataAdapter, simplify_with_attributes_and_locks};

/// A difference of colours, of 1, weighs as much as this share of the size of the mesh: about a metre in a site of 100 m.
const COLOR_SHARE: f32 = 0.01;

/// The mesh with at most `triangles` triangles, or with more if fewer would break its shape. A mesh that has as few already
/// stays as it is.
pub fn decimate(mesh: Mesh, triangles: usize) -> Mesh {
    if mesh.triangles.len() <= triangles {
        return mesh;
    }
    let colors: Vec<[f32; 3]> = match mesh.rgb[..] {
        [] => vec![[0.0; 3]; mesh.positions.len()],
        _ => mesh.rgb.iter().map(|rgb| rgb.map(|value| f32::from(value) / 255.0)).collect(),
    };
    let positions = bytemuck::cast_slice(&mesh.positions);
    let Ok(adapter) = VertexDataAdapter::new(positions, size_of::<[f32; 3]>(), 0) else {
        return mesh; // positions are whole by their type, so this does not happen
    };
    let locks = vec![false; mesh.positions.len()];
    let kept = simplify_with_attributes_and_locks(
        mesh.triangles.as_flattened(),
        &adapter,
        colors.as_flattened(),
        &[COLOR_SHARE; 3],
        size_of::<[f32; 3]>(),
        &locks,
        3 * triangles,
        f32::MAX,
        SimplifyOptions::Prune,
        None,
    );
    let kept: Vec<[u32; 3]> =
        kept.chunks_exact(3).map(|corners| [corners[0], corners[1], corners[2]]).collect();
    with_triangles(mesh, &kept)
}

/// Some triangles of a mesh, with their vertices in the order of the mesh.
fn with_triangles(mesh: Mesh, triangles: &[[u32; 3]]) -> Mesh {
    let mut new_of_old = vec![u32::MAX; mesh.positions.len()];
    triangles.as_flattened().iter().for_each(|vertex| new_of_old[*vertex as usize] = 0);
    let kept: Vec<usize> = (0..new_of_old.len()).filter(|old| new_of_old[*old] == 0).collect();
    kept.iter().enumerate().for_each(|(new, old)| new_of_old[*old] = new as u32);
    Mesh {
        origin: mesh.origin,
        positions: kept.iter().map(|old| mesh.positions[*old]).collect(),
        normals: kept.iter().filter_map(|old| mesh.normals.get(*old).copied()).collect(),
        rgb: kept.iter().filter_map(|old| mesh.rgb.get(*old).copied()).collect(),
        triangles: triangles
            .iter()
            .map(|corners| corners.map(|vertex| new_of_old[vertex as usize]))
            .collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A gable roof of 20 × 20 cells, of one colour per side.
    fn roof() -> Mesh {
        let at = |i: u32| [(i % 21) as f32, (i / 21) as f32];
        let cells = (0..21 * 20).filter(|i| i % 21 < 20);
        Mesh {
            positions: (0..441).map(|i| [at(i)[0], at(i)[1], 5.0 - (at(i)[0] - 10.0).abs() / 2.0]).collect(),
            rgb: (0..441).map(|i| if at(i)[0] < 10.0 { [200, 0, 0] } else { [0, 0, 200] }).collect(),
            normals: vec![[0.0, 0.0, 1.0]; 441],
            triangles: cells.flat_map(|i| [[i, i + 1, i + 22], [i, i + 22, i + 21]]).collect(),
            ..Mesh::default()
        }
    }

    #[test]
    fn the_shape_stays_with_few_triangles() {
        let mesh = decimate(roof(), 40);
        assert!((4..=40).contains(&mesh.triangles.len()), "{}", mesh.triangles.len());
        let vertices = mesh.positions.len();
        assert!(vertices < 60 && mesh.rgb.len() == vertices && mesh.normals.len() == vertices);
        let ridge = mesh.positions.iter().filter(|position| position[2] == 5.0);
        assert!(ridge.count() >= 2, "the ridge stays");
        let area: f64 = mesh.areas().sum();
        assert!((area - roof().areas().sum::<f64>()).abs() < 1e-3 * area, "{area}");
        assert_eq!(decimate(roof(), 800), roof());
    }
}
