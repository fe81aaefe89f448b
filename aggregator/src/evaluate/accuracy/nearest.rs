//! Finds the nearest points of a cloud of `f32` points with the engine's k-d tree, which is built on
//! several threads.

use cosurf_engine::nearest;
use glam::Vec3;

/// Ranges of the tree with at most this many points are searched point by point.
const LEAF: usize = 8;

/// A k-d tree of points.
pub(super) struct Tree(nearest::Tree<f32>);

impl Tree {
    /// Builds the tree. There must be fewer than 2³² points, and all must be finite.
    pub(super) fn new(points: &[Vec3]) -> Self {
        let points: Vec<[f32; 3]> = points.iter().map(Vec3::to_array).collect();
        Self(nearest::Tree::new_parallel(&points, LEAF))
    }

    /// Squared distances to the `K` nearest points, and the indices of these points, nearest first. If
    /// there are fewer than `K` points, the last distances are infinite.
    pub(super) fn nearest<const K: usize>(&self, query: Vec3) -> [(f32, u32); K] {
        self.0.nearest(query.to_array()).map(|near| (near.distance_squared, near.index))
    }

    /// Whether any point is nearer to `query` than the square root of `reach2`.
    pub(super) fn is_any_within(&self, query: Vec3, reach2: f32) -> bool {
        self.0.is_any_within(query.to_array(), reach2)
    }
}
