//! Divides the triangles of a mesh among the leaves of a quadtree over x and y.
//!
//! What it knows nothing about: files and errors.

use cosurf_scene::Mesh;
use glam::{DVec2, Vec2};

/// Leaves have about this many triangles before decimation: an eighth of them, less than a megabyte, are left.
const LEAF_TRIANGLES: usize = 150_000;
/// Largest depth of a leaf: 65,536 leaves.
const DEPTH_MAX: u32 = 8;

/// The place of a tile among those of its level: the bits of column and row, interleaved, so that four tiles of one parent
/// follow each other.
pub(super) type Key = u32;

/// The tile above a tile.
pub(super) fn parent(key: Key) -> Key {
    key >> 2
}

/// The key of a tile, by its column and row, which are below 65,536.
pub(super) fn key_of([x, y]: [u32; 2]) -> Key {
    interleaved(x) | interleaved(y) << 1
}

/// The triangles, leaf by leaf.
pub(super) struct Quadtree {
    depth: u32,
    /// Indices of the triangles, those of one leaf after the other.
    order: Vec<u32>,
    /// For each key: where its triangles begin in `order`; and the end.
    begins: Vec<usize>,
    /// For each key: the rectangle of x and y around its triangles.
    bounds: Vec<[Vec2; 2]>,
}

impl Quadtree {
    /// Divides the triangles whose three vertices are seen; `None` if there are none.
    pub(super) fn of(mesh: &Mesh, is_seen: &[bool]) -> Option<Self> {
        let seen = |triangle: &u32| mesh.triangles[*triangle as usize].iter().all(|v| is_seen[*v as usize]);
        let wanted = || (0..mesh.triangles.len() as u32).filter(seen);
        let (mut low, mut high, mut count) = (DVec2::INFINITY, DVec2::NEG_INFINITY, 0);
        for triangle in wanted() {
            let at = middle(mesh, triangle);
            (low, high, count) = (low.min(at), high.max(at), count + 1);
        }
        if count == 0 {
            return None;
        }
        let depth = (0..DEPTH_MAX).find(|depth| count >> (2 * depth) <= LEAF_TRIANGLES).unwrap_or(DEPTH_MAX);
        let across = 1u32 << depth;
        let side = (high - low).max_element().max(f64::MIN_POSITIVE);
        let key = |triangle: u32| {
            let cell = (middle(mesh, triangle) - low) / side * f64::from(across);
            key_of(cell.to_array().map(|of| (of as u32).min(across - 1)))
        };
        let mut begins = vec![0; (across * across) as usize + 1];
        wanted().for_each(|triangle| begins[key(triangle) as usize + 1] += 1);
        for leaf in 1..begins.len() {
            begins[leaf] += begins[leaf - 1];
        }
        let (mut next, mut order) = (begins.clone(), vec![0; count]);
        for triangle in wanted() {
            let place = &mut next[key(triangle) as usize];
            order[*place] = triangle;
            *place += 1;
        }
        let of_leaf = |range: &[usize]| {
            let triangles = order[range[0]..range[1]].iter();
            bounds(
                triangles
                    .flat_map(|triangle| mesh.corners(*triangle as usize))
                    .map(|corner| corner.truncate()),
            )
        };
        let bounds = begins.windows(2).map(of_leaf).collect();
        Some(Self { depth, order, begins, bounds })
    }

    /// Size in memory, bytes.
    pub(super) fn bytes(&self) -> u64 {
        let Self { order, begins, bounds, .. } = self;
        (size_of_val(&order[..]) + size_of_val(&begins[..]) + size_of_val(&bounds[..])) as u64
    }

    /// Depth of the leaves; the root has 0.
    pub(super) fn depth(&self) -> u32 {
        self.depth
    }

    /// The leaves that have triangles, ascending.
    pub(super) fn leaves(&self) -> impl Iterator<Item = Key> {
        (0..self.begins.len() - 1)
            .filter(|leaf| self.begins[*leaf] < self.begins[leaf + 1])
            .map(|leaf| leaf as Key)
    }

    /// The triangles that touch a rectangle of x and y.
    pub(super) fn touching(&self, mesh: &Mesh, low: DVec2, high: DVec2) -> Vec<[u32; 3]> {
        let touches = |bounds: &[Vec2; 2]| {
            bounds[0].as_dvec2().cmple(high).all() && bounds[1].as_dvec2().cmpge(low).all()
        };
        let of_triangle = |triangle: &u32| {
            let corners = mesh.corners(*triangle as usize).map(|corner| corner.truncate());
            touches(&bounds(corners.into_iter()))
        };
        let leaves = self.leaves().filter(|leaf| touches(&self.bounds[*leaf as usize]));
        let triangles = leaves.flat_map(|leaf| self.range(leaf)).copied().filter(of_triangle);
        triangles.map(|triangle| mesh.triangles[triangle as usize]).collect()
    }

    /// The triangles of a leaf.
    pub(super) fn triangles(&self, mesh: &Mesh, leaf: Key) -> Vec<[u32; 3]> {
        self.range(leaf).iter().map(|triangle| mesh.triangles[*triangle as usize]).collect()
    }

    /// For each vertex of the mesh: whether several leaves have it.
    pub(super) fn shared_by_leaves(&self, mesh: &Mesh) -> Vec<bool> {
        let of_leaf = |leaf: Key| {
            self.range(leaf).iter().map(move |triangle| (leaf, mesh.triangles[*triangle as usize]))
        };
        shared(mesh.positions.len(), self.leaves().flat_map(of_leaf))
    }

    fn range(&self, leaf: Key) -> &[u32] {
        &self.order[self.begins[leaf as usize]..self.begins[leaf as usize + 1]]
    }
}

/// For each vertex: whether triangles of different tiles have it.
pub(super) fn shared(vertices: usize, triangles: impl Iterator<Item = (Key, [u32; 3])>) -> Vec<bool> {
    const NOBODY: Key = Key::MAX;
    let mut owners = vec![NOBODY; vertices];
    let mut is_shared = vec![false; vertices];
    for (key, corners) in triangles {
        for vertex in corners.map(|vertex| vertex as usize) {
            is_shared[vertex] |= owners[vertex] != NOBODY && owners[vertex] != key;
            owners[vertex] = key;
        }
    }
    is_shared
}

/// The rectangle around some positions.
fn bounds(positions: impl Iterator<Item = Vec2>) -> [Vec2; 2] {
    positions.fold([Vec2::INFINITY, Vec2::NEG_INFINITY], |[low, high], at| [low.min(at), high.max(at)])
}

fn middle(mesh: &Mesh, triangle: u32) -> DVec2 {
    let [a, b, c] = mesh.corners(triangle as usize);
    ((a + b + c) / 3.0).truncate().as_dvec2()
}

/// The lowest 16 bits with a zero before each.
fn interleaved(bits: u32) -> u32 {
    (0..16).map(|bit| (bits >> bit & 1) << (2 * bit)).sum()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn keys_of_neighbours_have_one_parent() {
        assert_eq!([0, 1, 2, 3, 0x8001].map(interleaved), [0, 1, 4, 5, 0x4000_0001]);
        let key = |x: u32, y: u32| key_of([x, y]);
        assert!([key(4, 6), key(5, 6), key(4, 7), key(5, 7)].iter().all(|of| parent(*of) == key(2, 3)));
    }

    #[test]
    fn every_seen_triangle_is_in_one_leaf() {
        // A strip of many small triangles.
        let count = 2 * LEAF_TRIANGLES as u32;
        let mesh = Mesh {
            positions: (0..count + 2).map(|i| [i as f32 * 0.01, (i % 2) as f32, 0.0]).collect(),
            triangles: (0..count).map(|i| [i, i + 1, i + 2]).collect(),
            ..Mesh::default()
        };
        let is_seen: Vec<bool> = (0..mesh.positions.len()).map(|vertex| vertex >= 1000).collect();
        let tree = Quadtree::of(&mesh, &is_seen).unwrap();
        assert_eq!((tree.depth(), tree.leaves().count()), (1, 2), "the strip is in the southern leaves");
        let mut all: Vec<[u32; 3]> = tree.leaves().flat_map(|leaf| tree.triangles(&mesh, leaf)).collect();
        all.sort_unstable();
        assert!(all == mesh.triangles[1000..]);
        let is_shared = tree.shared_by_leaves(&mesh);
        assert_eq!(is_shared.iter().filter(|is_shared| **is_shared).count(), 2);
        let mut touching = tree.touching(&mesh, DVec2::new(20.0, 0.5), DVec2::new(20.015, 0.6));
        touching.sort_unstable();
        assert_eq!(touching, mesh.triangles[1998..2002]);
        assert!(Quadtree::of(&mesh, &vec![false; is_seen.len()]).is_none());
    }
}
