//! Where a mesh is judged: over the truth's footprint on the ground.

use glam::Vec3;

use super::nearest::Tree;

/// The footprint reaches so far beyond the truth's points, in their mean distances: at random, less
/// than one place in a hundred thousand within it is farther from all of them.
const SPACINGS: f64 = 2.0;

/// The places that are near the truth when both are seen from above.
pub(super) struct Region {
    tree: Tree,
    reach2_m2: f32,
}

impl Region {
    /// The truth's points, which lie `spacing_m` apart, and what is within the threshold of them, or
    /// within two such spacings where these are more. Farther out would count what is right, but of
    /// which nobody knows the truth, as wrong.
    pub(super) fn new(truth: &[Vec3], spacing_m: f64, threshold_m: f64) -> Self {
        let flat: Vec<Vec3> = truth.iter().map(|p| flatten(*p)).collect();
        let reach_m = threshold_m.max(SPACINGS * spacing_m) as f32;
        Self { tree: Tree::new(&flat), reach2_m2: reach_m * reach_m }
    }

    pub(super) fn contains(&self, p: Vec3) -> bool {
        self.tree.is_any_within(flatten(p), self.reach2_m2)
    }
}

fn flatten(p: Vec3) -> Vec3 {
    p.with_z(0.0)
}
