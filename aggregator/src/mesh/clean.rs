//! Cleans a mesh after marching cubes: removes specks and computes normals.

use cosurf_scene::Mesh;
use glam::Vec3;

/// A connected piece with fewer triangles than this is a speck. The smallest body that the fusion resolves is
/// a ball with a radius of one truncation distance, which has about as many triangles. All larger pieces
/// stay, because an aerial scene may have several.
const TRIANGLES_MIN: u32 = 400;

/// Removes small pieces and vertices without triangles; the rest keeps its order.
pub(super) fn remove_specks(mesh: &mut Mesh) {
    let mut parents: Vec<u32> = (0..mesh.positions.len() as u32).collect();
    for &[a, b, c] in &mesh.triangles {
        join(&mut parents, a, b);
        join(&mut parents, b, c);
    }
    let mut triangles_of = vec![0u32; parents.len()];
    for &[a, ..] in &mesh.triangles {
        triangles_of[root(&mut parents, a) as usize] += 1;
    }
    // Moves the kept vertices to the front. After that, `renumber` turns `parents` into the new indices of
    // the vertices.
    let mut kept = 0;
    for vertex in 0..parents.len() {
        let piece = root(&mut parents, vertex as u32);
        let stays = triangles_of[piece as usize] >= TRIANGLES_MIN;
        mesh.positions[kept] = mesh.positions[vertex];
        mesh.rgb[kept] = mesh.rgb[vertex];
        if stays {
            kept += 1;
        }
    }
    renumber(mesh, &mut parents, &triangles_of);
    mesh.positions.truncate(kept);
    mesh.rgb.truncate(kept);
}

/// Removes the triangles of specks, and gives the other triangles the new indices of their vertices.
/// Overwrites `parents` with the new indices.
fn renumber(mesh: &mut Mesh, parents: &mut [u32], triangles_of: &[u32]) {
    mesh.triangles.retain(|&[a, ..]| triangles_of[root(parents, a) as usize] >= TRIANGLES_MIN);
    let stays: Vec<bool> = (0..parents.len() as u32)
        .map(|vertex| triangles_of[root(parents, vertex) as usize] >= TRIANGLES_MIN)
        .collect();
    let mut next = 0;
    for (new, stays) in parents.iter_mut().zip(stays) {
        *new = next;
        next += u32::from(stays);
    }
    for triangle in &mut mesh.triangles {
        *triangle = triangle.map(|vertex| parents[vertex as usize]);
    }
}

/// The root of a vertex's piece in the union–find forest `parents`. Shortens the path to it.
fn root(parents: &mut [u32], mut vertex: u32) -> u32 {
    while parents[vertex as usize] != vertex {
        let grandparent = parents[parents[vertex as usize] as usize];
        parents[vertex as usize] = grandparent;
        vertex = grandparent;
    }
    vertex
}

/// Joins the pieces of two vertices. The smaller root becomes the root of both, so the root of a piece does
/// not depend on the order of joins.
fn join(parents: &mut [u32], a: u32, b: u32) {
    let (a, b) = (root(parents, a), root(parents, b));
    parents[a.max(b) as usize] = a.min(b);
}

/// Unit normals of the vertices: at each vertex the mean of its triangles' normals, weighted by their areas.
pub(super) fn normals(mesh: &Mesh) -> Vec<[f32; 3]> {
    let mut normals = vec![[0.0; 3]; mesh.positions.len()];
    for (i, triangle) in mesh.triangles.iter().enumerate() {
        let [a, b, c] = mesh.corners(i);
        let normal = (b - a).cross(c - a);
        for &vertex in triangle {
            let sum = &mut normals[vertex as usize];
            *sum = (Vec3::from_array(*sum) + normal).to_array();
        }
    }
    for normal in &mut normals {
        *normal = Vec3::from_array(*normal).normalize_or_zero().to_array();
    }
    normals
}
