//! Parts of a mesh: some of its triangles, with their own vertices.
//!
//! What it knows nothing about: which triangles, and what for.

use cosurf_scene::Mesh;

/// Size of a mesh in memory, bytes.
pub(super) fn bytes(mesh: &Mesh) -> u64 {
    let Mesh { positions, normals, rgb, triangles, .. } = mesh;
    let sizes = [size_of_val(&positions[..]), size_of_val(&normals[..]), size_of_val(&rgb[..])];
    (sizes.iter().sum::<usize>() + size_of_val(&triangles[..])) as u64
}

/// The vertices of some triangles, ascending.
pub(super) fn vertices(triangles: &[[u32; 3]]) -> Vec<u32> {
    let mut vertices = triangles.as_flattened().to_vec();
    vertices.sort_unstable();
    vertices.dedup();
    vertices
}

/// The triangles with the places of their vertices among `vertices`, which are ascending and have all of them.
pub(super) fn renumbered(triangles: &[[u32; 3]], vertices: &[u32]) -> Vec<[u32; 3]> {
    let place = |vertex: u32| vertices.partition_point(|other| *other < vertex) as u32;
    triangles.iter().map(|triangle| triangle.map(place)).collect()
}

/// A mesh of some triangles, in the frame of the whole, without normals.
pub(super) fn part(mesh: &Mesh, triangles: &[[u32; 3]]) -> Mesh {
    let vertices = vertices(triangles);
    Mesh {
        origin: mesh.origin,
        positions: vertices.iter().map(|vertex| mesh.positions[*vertex as usize]).collect(),
        normals: Vec::new(),
        rgb: vertices.iter().filter_map(|vertex| mesh.rgb.get(*vertex as usize).copied()).collect(),
        triangles: renumbered(triangles, &vertices),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_have_the_vertices_of_their_triangles() {
        let mesh = Mesh {
            positions: (0..9).map(|i| [i as f32, 0.0, 0.0]).collect(),
            rgb: (0..9).map(|i| [i, 0, 0]).collect(),
            triangles: vec![[0, 1, 2], [8, 3, 5], [3, 8, 6]],
            ..Mesh::default()
        };
        let part = part(&mesh, &mesh.triangles[1..]);
        assert_eq!(part.triangles, [[3, 0, 1], [0, 3, 2]]);
        assert_eq!(part.positions.iter().map(|at| at[0]).collect::<Vec<_>>(), [3.0, 5.0, 6.0, 8.0]);
        assert_eq!(part.rgb, [[3, 0, 0], [5, 0, 0], [6, 0, 0], [8, 0, 0]]);
    }
}
