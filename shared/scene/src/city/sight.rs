//! Which cameras see a place.

use glam::{DMat3, DVec3};

use super::bvh::{Bvh, Ray};
use crate::Camera;

/// How much of the line of sight at its end may lie inside the surface, metres.
const SLACK_M: f32 = 0.03;

/// A flight's cameras, asked who sees what.
#[derive(Clone, Debug)]
pub(super) struct Sight<'a> {
    bvh: &'a Bvh,
    pub(super) cameras: &'a [Camera],
    eyes: Vec<Eye>,
}

/// A camera as the question wants it.
#[derive(Clone, Copy, Debug)]
struct Eye {
    center: DVec3,
    /// World to pixels times depth, and depth.
    pixels_from_world: DMat3,
    width: f64,
    height: f64,
}

impl Eye {
    fn new(camera: &Camera) -> Self {
        let (f, c) = (camera.focal_px, camera.center_px);
        let intrinsics =
            DMat3::from_cols(DVec3::new(f.x, 0.0, 0.0), DVec3::new(0.0, f.y, 0.0), DVec3::new(c.x, c.y, 1.0));
        Self {
            center: camera.cam_from_world.center(),
            pixels_from_world: intrinsics * DMat3::from_quat(camera.cam_from_world.rotation),
            width: f64::from(camera.size_px[0]),
            height: f64::from(camera.size_px[1]),
        }
    }

    /// Whether a point lies in the picture, or would if nothing were before it.
    fn faces(&self, point: DVec3) -> bool {
        let p = self.pixels_from_world * (point - self.center);
        p.z > 0.0 && p.x >= 0.0 && p.y >= 0.0 && p.x < self.width * p.z && p.y < self.height * p.z
    }
}

impl<'a> Sight<'a> {
    pub(super) fn new(bvh: &'a Bvh, cameras: &'a [Camera]) -> Self {
        Self { bvh, cameras, eyes: cameras.iter().map(Eye::new).collect() }
    }

    /// Whether camera `i` sees the point: in its picture and nothing before it.
    pub(super) fn sees(&self, i: usize, point: DVec3) -> bool {
        self.eyes[i].faces(point) && self.is_clear(i, point)
    }

    /// The first `count` cameras that see the point, if there are so many.
    pub(super) fn seen_by(&self, point: DVec3, count: usize) -> Option<Vec<usize>> {
        let facing: Vec<usize> = (0..self.eyes.len()).filter(|&i| self.eyes[i].faces(point)).collect();
        let mut seen = Vec::with_capacity(count);
        for (tried, &i) in facing.iter().enumerate() {
            if seen.len() + facing.len() - tried < count {
                return None;
            }
            if self.is_clear(i, point) {
                seen.push(i);
                if seen.len() == count {
                    return Some(seen);
                }
            }
        }
        None
    }

    /// Whether nothing is between a camera and a point. Followed from the point, since what hides
    /// a place is most often close to it.
    fn is_clear(&self, i: usize, point: DVec3) -> bool {
        let line = (self.eyes[i].center - point).as_vec3();
        let t_min = SLACK_M / line.length();
        !self.bvh.blocked(&[Ray { origin: point.as_vec3(), direction: line, t_min, t_max: 1.0 }])[0]
    }
}
