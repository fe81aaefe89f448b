//! Which ground enough cameras see to be measured.
//!
//! What it knows nothing about: what hides the ground. It has no occlusion, because a mesh has a surface only where
//! cameras saw it.

use cosurf_scene::{Camera, Frustum};
use glam::DVec3;

/// The cameras of a model, in the world.
#[derive(Debug)]
pub(super) struct Witnesses {
    cameras: Vec<Camera>,
    frusta: Vec<Frustum>,
}

impl Witnesses {
    pub(super) fn of(cameras: &[Camera]) -> Self {
        Self { cameras: cameras.to_vec(), frusta: cameras.iter().map(Frustum::new).collect() }
    }

    /// All cameras that may see a point in this ball; radius in metres.
    pub(super) fn of_ball(&self, center: DVec3, radius_m: f64) -> Vec<usize> {
        (0..self.frusta.len()).filter(|camera| self.frusta[*camera].touches(center, radius_m)).collect()
    }

    /// Whether two of these cameras see a point from different places. Two agents may have the same picture: that is one
    /// view, from which nothing can be measured.
    pub(super) fn see(&self, among: &[usize], at: DVec3) -> bool {
        let mut seeing = among.iter().filter(|camera| self.frusta[**camera].contains(at));
        let Some(first) = seeing.next() else { return false };
        let first = &self.cameras[*first];
        let depth = first.cam_from_world.transform(at).z;
        seeing.any(|camera| !self.cameras[*camera].views_alike(first, depth))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::above;

    #[test]
    fn two_places_are_needed_to_see_a_point() {
        // Each camera sees 12 m of the ground, along x.
        let witnesses = Witnesses::of(&[above(0.0), above(0.01), above(8.0)]);
        let all = witnesses.of_ball(DVec3::ZERO, 20.0);
        assert_eq!(all, [0, 1, 2]);
        assert!(!witnesses.see(&all, DVec3::ZERO), "two cameras at one place");
        assert!(witnesses.see(&all, DVec3::new(4.0, 0.0, 0.0)));
        assert!(!witnesses.see(&all, DVec3::new(9.0, 0.0, 0.0)), "one camera");
        assert!(!witnesses.see(&all, DVec3::new(40.0, 0.0, 0.0)));
        assert_eq!(witnesses.of_ball(DVec3::new(14.0, 0.0, 0.0), 1.0), [2]);
    }
}
