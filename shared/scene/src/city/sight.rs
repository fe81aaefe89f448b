//! Which cameras see a place.

use glam::{DMat3, DVec3, Vec3};

use crate::Camera;
use crate::bvh::{Bvh, Ray};

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
    /// By how much each of its results can change over a metre.
    row_lengths: [f64; 3],
    width: f64,
    height: f64,
}

impl Eye {
    fn new(camera: &Camera) -> Self {
        let (f, c) = (camera.focal_px, camera.center_px);
        let intrinsics =
            DMat3::from_cols(DVec3::new(f.x, 0.0, 0.0), DVec3::new(0.0, f.y, 0.0), DVec3::new(c.x, c.y, 1.0));
        let pixels_from_world = intrinsics * DMat3::from_quat(camera.cam_from_world.rotation);
        let rows = pixels_from_world.transpose();
        Self {
            center: camera.cam_from_world.center(),
            pixels_from_world,
            row_lengths: [rows.x_axis.length(), rows.y_axis.length(), rows.z_axis.length()],
            width: f64::from(camera.size_px[0]),
            height: f64::from(camera.size_px[1]),
        }
    }

    /// Whether a point lies in the picture, or would if nothing were before it.
    fn faces(&self, point: DVec3) -> bool {
        let p = self.pixels_from_world * (point - self.center);
        p.z > 0.0 && p.x >= 0.0 && p.y >= 0.0 && p.x < self.width * p.z && p.y < self.height * p.z
    }

    /// Whether some of a ball may lie in the picture; never no where it does.
    fn may_face(&self, center: DVec3, radius_m: f64) -> bool {
        let p = self.pixels_from_world * (center - self.center);
        let [x, y, z] = self.row_lengths.map(|length| length * radius_m);
        p.z > -z
            && p.x >= -x
            && p.y >= -y
            && p.x < self.width * (p.z + z) + x
            && p.y < self.height * (p.z + z) + y
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

    /// Whether `count` cameras may see some of a triangle; never no where they do.
    pub(super) fn may_be_seen_by(&self, corners: &[Vec3; 3], count: usize) -> bool {
        let center = (corners[0] + corners[1] + corners[2]) * (1.0 / 3.0);
        let radius = corners.iter().map(|corner| corner.distance(center)).fold(0.0, f32::max);
        let (center, radius) = (center.as_dvec3(), f64::from(radius));
        self.eyes.iter().filter(|eye| eye.may_face(center, radius)).take(count).count() == count
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
