//! Nearest points of a cloud of `f32`: the engine's k-d tree, built and asked in parallel.

use cosurf_engine::nearest;
use glam::Vec3;

/// Ranges no longer are searched one by one.
const LEAF: usize = 8;

/// Points with their indices.
pub(super) struct Tree(nearest::Tree<f32>);

impl Tree {
    /// Builds the tree. There must be fewer than 2³² points, and all must be finite.
    pub(super) fn new(points: &[Vec3]) -> Self {
        let points: Vec<[f32; 3]> = points.iter().map(Vec3::to_array).collect();
        Self(nearest::Tree::new_parallel(&points, LEAF))
    }

    /// Squared distances to the `K` nearest points and their indices, ascending; infinite where there
    /// are fewer.
    pub(super) fn nearest<const K: usize>(&self, query: Vec3) -> [(f32, u32); K] {
        self.0.nearest(query.to_array()).map(|near| (near.distance_squared, near.index))
    }

    /// Whether a point lies nearer than the root of `reach2`.
    pub(super) fn is_any_within(&self, query: Vec3, reach2: f32) -> bool {
        self.0.is_any_within(query.to_array(), reach2)
    }
}
