//! Which cameras see a place.

use glam::DVec3;

use super::bvh::{Bvh, Ray};
use crate::Camera;

/// How much of the line of sight at its end may lie inside the surface, metres.
const SLACK_M: f32 = 0.03;

/// A flight's cameras, asked who sees what.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sight<'a> {
    pub(super) bvh: &'a Bvh,
    pub(super) cameras: &'a [Camera],
}

impl Sight<'_> {
    /// Whether camera `i` sees the point: in its picture and nothing before it.
    pub(super) fn sees(&self, i: usize, point: DVec3) -> bool {
        let camera = &self.cameras[i];
        if !camera.project(point).is_some_and(|p_px| camera.contains(p_px)) {
            return false;
        }
        let center = camera.cam_from_world.center();
        let line = (point - center).as_vec3();
        !self.bvh.blocked(&Ray {
            origin: center.as_vec3(),
            direction: line,
            t_min: 0.0,
            t_max: 1.0 - SLACK_M / line.length(),
        })
    }

    /// The first `count` cameras that see the point, if there are so many.
    pub(super) fn seen_by(&self, point: DVec3, count: usize) -> Option<Vec<usize>> {
        let in_view = |i: &usize| {
            let camera = &self.cameras[*i];
            camera.project(point).is_some_and(|p_px| camera.contains(p_px))
        };
        let candidates: Vec<usize> = (0..self.cameras.len()).filter(in_view).collect();
        let mut seen = Vec::with_capacity(count);
        for (tried, &i) in candidates.iter().enumerate() {
            if seen.len() + candidates.len() - tried < count {
                return None;
            }
            if self.sees(i, point) {
                seen.push(i);
                if seen.len() == count {
                    return Some(seen);
                }
            }
        }
        None
    }
}
