//! The region in which a mesh is scored: above the truth's footprint on the ground.

use glam::Vec3;

use super::nearest::Tree;

/// The footprint reaches at least this far beyond the truth's points, in mean distances between these points.
/// If points are spread at random over a surface, less than one place in 100 000 is farther than this from all
/// of them.
const SPACINGS: f64 = 2.0;

/// The positions that are near the truth's points when seen from above.
pub(super) struct Region {
    tree: Tree,
    reach2_m2: f32,
}

impl Region {
    /// `truth` are points about `spacing_m` apart. The region reaches beyond them by the threshold or by two
    /// spacings, whichever is larger. A larger region would include surface where the truth is unknown, and
    /// count it as wrong.
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
