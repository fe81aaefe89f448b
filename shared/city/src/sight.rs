//! Tests which cameras see a point.

use glam::{DMat3, DVec3, Vec3};

use cosurf_scene::Camera;
use cosurf_scene::bvh::{Bvh, Ray};

/// Length at the end of a line of sight that may lie inside the surface, metres.
const SLACK_M: f32 = 0.03;

/// Tests what a flight's cameras see of the city.
#[derive(Clone, Debug)]
pub(super) struct Sight<'a> {
    bvh: &'a Bvh,
    pub(super) cameras: &'a [Camera],
    eyes: Vec<Eye>,
}

/// A camera in the form that the tests need.
#[derive(Clone, Copy, Debug)]
struct Eye {
    center: DVec3,
    /// Maps an offset from the centre to column × depth, row × depth and depth.
    pixels_from_world: DMat3,
    /// Lengths of its rows: the largest change of each result per metre.
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

    /// Whether a point projects into the picture, whether or not it is occluded.
    fn faces(&self, point: DVec3) -> bool {
        let p = self.pixels_from_world * (point - self.center);
        p.z > 0.0 && p.x >= 0.0 && p.y >= 0.0 && p.x < self.width * p.z && p.y < self.height * p.z
    }

    /// Whether part of a ball may project into the picture. May err towards true, never towards false.
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

    /// Whether camera `i` sees the point: it projects into the picture and is not occluded.
    pub(super) fn sees(&self, i: usize, point: DVec3) -> bool {
        self.eyes[i].faces(point) && self.is_clear(i, point)
    }

    /// Whether `count` cameras may see part of a triangle. May err towards true, never towards false.
    pub(super) fn may_be_seen_by(&self, corners: &[Vec3; 3], count: usize) -> bool {
        let center = (corners[0] + corners[1] + corners[2]) * (1.0 / 3.0);
        let radius = corners.iter().map(|corner| corner.distance(center)).fold(0.0, f32::max);
        let (center, radius) = (center.as_dvec3(), f64::from(radius));
        self.eyes.iter().filter(|eye| eye.may_face(center, radius)).take(count).count() == count
    }

    /// The first `count` cameras that see the point; `None` if there are fewer.
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

    /// Whether nothing occludes a point from a camera. The ray starts at the point, as occluders are
    /// mostly close to it.
    fn is_clear(&self, i: usize, point: DVec3) -> bool {
        let line = (self.eyes[i].center - point).as_vec3();
        let t_min = SLACK_M / line.length();
        !self.bvh.blocked(&[Ray { origin: point.as_vec3(), direction: line, t_min, t_max: 1.0 }])[0]
    }
}
