//! The region in which a mesh is scored: above the truth's footprint on the ground.

use glam::Vec3;

use super::nearest::Tree;

/// Reach of the footprint beyond the truth's points, in mean point distances. Between random points, less than
/// one place in a hundred thousand is farther than this from all of them.
const SPACINGS: f64 = 2.0;

/// The positions that are near the truth when seen from above.
pub(super) struct Region {
    tree: Tree,
    reach2_m2: f32,
}

impl Region {
    /// `truth` are points about `spacing_m` apart. The region reaches beyond them by the threshold or by two
    /// spacings, whichever is larger. A larger region would count correct surface of unknown truth as wrong.
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
