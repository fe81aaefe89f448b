//! Cleans a mesh after marching cubes: removes specks and computes normals.

use cosurf_scene::{Mesh, MeshCounts};
use glam::Vec3;

/// A connected piece with fewer triangles than this is a speck. The smallest body that the fusion resolves is
/// a ball with a radius of one truncation distance, which has about as many triangles. All larger pieces
/// stay, because an aerial scene may have several.
const TRIANGLES_MIN: u32 = 400;

/// The connected pieces of a mesh, as a union–find forest of its vertices. The root of a piece is its first vertex.
pub(super) struct Pieces {
    parents: Vec<u32>,
    /// For the root of each piece, the number of its triangles.
    triangles: Vec<u32>,
}

impl Pieces {
    /// Bytes per vertex.
    pub(super) const VERTEX_BYTES: u64 = 8;

    /// So many vertices, of which each is a piece of its own.
    pub(super) fn new(vertices: usize) -> Self {
        Self { parents: (0..vertices as u32).collect(), triangles: vec![0; vertices] }
    }

    /// Joins the pieces that triangles connect.
    pub(super) fn join(&mut self, triangles: &[[u32; 3]]) {
        for &[a, b, c] in triangles {
            join(&mut self.parents, a, b);
            join(&mut self.parents, b, c);
        }
    }

    /// Counts triangles, after all were joined.
    pub(super) fn count(&mut self, triangles: &[[u32; 3]]) {
        for &[a, ..] in triangles {
            self.triangles[root(&mut self.parents, a) as usize] += 1;
        }
    }

    /// Removes specks, after all triangles were counted.
    pub(super) fn without_specks(self) -> Kept {
        let Self { mut parents, triangles } = self;
        // A parent comes before its children, so this makes every parent a root.
        for vertex in 0..parents.len() {
            parents[vertex] = parents[parents[vertex] as usize];
        }
        let stays = |root: u32| triangles[root as usize] >= TRIANGLES_MIN;
        let vertices = parents.iter().filter(|root| stays(**root)).count();
        let counts = MeshCounts {
            vertices: vertices as u64,
            triangles: triangles
                .iter()
                .filter(|&&count| count >= TRIANGLES_MIN)
                .map(|&count| u64::from(count))
                .sum(),
        };
        let mut next = vertices as u32;
        for parent in parents.iter_mut().rev() {
            next -= u32::from(stays(*parent));
            *parent = if stays(*parent) { next } else { REMOVED };
        }
        Kept { indices: parents, counts }
    }
}

/// Stands for the index of a vertex of a speck.
const REMOVED: u32 = u32::MAX;

/// Which vertices of a mesh stay when specks are removed, and their new indices. They keep their order.
pub(super) struct Kept {
    /// For each vertex of the mesh with specks, its new index, or [`REMOVED`].
    indices: Vec<u32>,
    /// Number of vertices and triangles that stay.
    pub(super) counts: MeshCounts,
}

impl Kept {
    /// Whether a vertex stays.
    pub(super) fn has(&self, vertex: usize) -> bool {
        self.indices[vertex] != REMOVED
    }

    /// A triangle with the new indices of its vertices; `None` if it belongs to a speck.
    pub(super) fn triangle(&self, triangle: [u32; 3]) -> Option<[u32; 3]> {
        let triangle = triangle.map(|vertex| self.indices[vertex as usize]);
        (triangle[0] != REMOVED).then_some(triangle)
    }

    /// Removes the values of vertices that do not stay. `values` has one for each vertex from the index `first` on.
    pub(super) fn retain<T: Copy>(&self, first: usize, values: &mut Vec<T>) {
        let mut vertex = first;
        values.retain(|_| {
            vertex += 1;
            self.has(vertex - 1)
        });
    }
}

/// Removes small pieces and vertices without triangles; the rest keeps its order.
pub(super) fn remove_specks(mesh: &mut Mesh) {
    let mut pieces = Pieces::new(mesh.positions.len());
    pieces.join(&mesh.triangles);
    pieces.count(&mesh.triangles);
    let kept = pieces.without_specks();
    kept.retain(0, &mut mesh.positions);
    kept.retain(0, &mut mesh.rgb);
    mesh.triangles.retain_mut(|triangle| match kept.triangle(*triangle) {
        Some(renumbered) => {
            *triangle = renumbered;
            true
        }
        None => false,
    });
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
        let normal = area_normal(mesh.corners(i));
        for &vertex in triangle {
            add(&mut normals[vertex as usize], normal);
        }
    }
    normals.iter_mut().for_each(normalize);
    normals
}

/// The normal of a triangle, as long as twice its area.
pub(super) fn area_normal([a, b, c]: [Vec3; 3]) -> Vec3 {
    (b - a).cross(c - a)
}

/// Adds the normal of a triangle to the sum at one of its vertices.
pub(super) fn add(sum: &mut [f32; 3], normal: Vec3) {
    *sum = (Vec3::from_array(*sum) + normal).to_array();
}

/// Makes a sum of normals a unit normal.
pub(super) fn normalize(normal: &mut [f32; 3]) {
    *normal = Vec3::from_array(*normal).normalize_or_zero().to_array();
}
