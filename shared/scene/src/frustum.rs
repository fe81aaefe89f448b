//! Checks quickly which cameras see a point. The merge of models makes this check more often than any other.

use glam::{DVec2, DVec3};

use crate::camera::Camera;

/// The volume that a camera sees, prepared so that checking a point needs no division.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Frustum {
    /// `rows[k] · p_world + offset[k]` is, for k = 0, 1 and 2: the pixel column times the depth, the pixel row times
    /// the depth, and the depth. Columns and rows are in pixels, the depth is in world units.
    rows: [DVec3; 3],
    offset: DVec3,
    size_px: DVec2,
    /// The left, top, right and bottom planes that bound the volume: a point lies inside if `normal · p_world + offset` is
    /// at least 0, with the unit vector `normal`.
    sides: [(DVec3, f64); 4],
    /// Depth at which the volume ends, world units.
    far: f64,
}

impl Frustum {
    /// The frustum of `camera`.
    pub fn new(camera: &Camera) -> Self {
        let Camera { cam_from_world: pose, focal_px, center_px, size_px } = camera;
        let world_from_cam = pose.rotation.inverse();
        let [x, y, z] = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| world_from_cam * axis);
        let at = pose.translation;
        let rows = [focal_px.x * x + center_px.x * z, focal_px.y * y + center_px.y * z, z];
        let offset =
            DVec3::new(focal_px.x * at.x + center_px.x * at.z, focal_px.y * at.y + center_px.y * at.z, at.z);
        let size_px = DVec2::new(f64::from(size_px[0]), f64::from(size_px[1]));
        let [column, row, depth] = rows;
        let sides = [
            (column, offset.x),
            (row, offset.y),
            (size_px.x * depth - column, size_px.x * offset.z - offset.x),
            (size_px.y * depth - row, size_px.y * offset.z - offset.y),
        ];
        let sides = sides.map(|(inwards, offset)| (inwards / inwards.length(), offset / inwards.length()));
        Self { rows, offset, size_px, sides, far: f64::INFINITY }
    }

    /// The part of the frustum up to the depth `far`, world units.
    pub fn up_to(self, far: f64) -> Self {
        Self { far, ..self }
    }

    /// Whether a world point lies in front of the camera and inside its picture. The result is that of
    /// [`Camera::sees`], except for rounding at the border of the picture.
    pub fn contains(&self, p_world: DVec3) -> bool {
        let [x, y, z] = self.rows.map(|row| row.dot(p_world));
        let [x, y, z] = [x + self.offset.x, y + self.offset.y, z + self.offset.z];
        // Behind the camera `size_px * z` is negative, so no `x >= 0` is less than it, and the result is false.
        x >= 0.0 && y >= 0.0 && x < self.size_px.x * z && y < self.size_px.y * z && z <= self.far
    }

    /// False if no point of the ball with this centre and radius lies in the frustum. May be true although none does.
    pub fn touches(&self, center: DVec3, radius: f64) -> bool {
        let depth = self.rows[2].dot(center) + self.offset.z;
        depth >= -radius
            && depth <= self.far + radius
            && self.sides.iter().all(|(inwards, offset)| inwards.dot(center) + offset >= -radius)
    }
}

/// Checks whether any of several cameras sees a point. Neighbouring points are mostly seen by the same camera, so
/// the camera that saw the previous point is tried first.
#[derive(Clone, Debug)]
pub struct Watchers<'a> {
    cameras: &'a [Camera],
    frusta: Vec<Frustum>,
    last: usize,
}

impl<'a> Watchers<'a> {
    /// Prepares the checks for `cameras`.
    pub fn new(cameras: &'a [Camera]) -> Self {
        Self { cameras, frusta: cameras.iter().map(Frustum::new).collect(), last: 0 }
    }

    /// Whether any camera sees a world point and satisfies `is_wanted`.
    pub fn any(&mut self, p_world: DVec3, is_wanted: impl Fn(&Camera) -> bool) -> bool {
        let sees = |i: usize| {
            self.frusta.get(i).is_some_and(|frustum| frustum.contains(p_world)) && is_wanted(&self.cameras[i])
        };
        if sees(self.last) {
            return true;
        }
        let found = (0..self.frusta.len()).find(|i| sees(*i));
        self.last = found.unwrap_or(self.last);
        found.is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Pose;

    /// Six cameras on a ring of radius 7 above the origin. They look down at points near the origin.
    fn cameras() -> Vec<Camera> {
        let camera = |i: u32| {
            let angle = f64::from(i);
            let eye = DVec3::new(7.0 * angle.cos(), 7.0 * angle.sin(), 5.0 + 0.3 * angle);
            Camera {
                cam_from_world: Pose::look_at(eye, DVec3::new(0.1 * angle, 0.0, 0.0), DVec3::Z),
                focal_px: DVec2::new(90.0, 110.0),
                center_px: DVec2::new(41.5, 28.0),
                size_px: [80, 60],
            }
        };
        (0..6).map(camera).collect()
    }

    /// A grid of points inside and outside the ring.
    fn places() -> impl Iterator<Item = DVec3> {
        let at = |i: i32| f64::from(i) * 0.83;
        (-12..12).flat_map(move |x| {
            (-12..12).flat_map(move |y| (-9..9).map(move |z| DVec3::new(at(x), at(y), at(z))))
        })
    }

    #[test]
    fn a_frustum_agrees_with_its_camera() {
        for camera in cameras() {
            let frustum = Frustum::new(&camera);
            let seen = places().filter(|place| camera.sees(*place)).count();
            assert!(seen > 100 && seen < places().count() / 2, "{seen}");
            assert!(places().all(|place| frustum.contains(place) == camera.sees(place)));
        }
    }

    #[test]
    fn a_frustum_may_end_at_a_depth() {
        for camera in cameras() {
            let (whole, short) = (Frustum::new(&camera), Frustum::new(&camera).up_to(5.0));
            let depth = |place: DVec3| camera.cam_from_world.transform(place).z;
            let is_left_out = |place: &DVec3| whole.contains(*place) && !short.contains(*place);
            let left_out: Vec<DVec3> = places().filter(is_left_out).collect();
            assert!(left_out.len() > 10 && left_out.into_iter().all(|place| depth(place) > 5.0));
            assert!(places().all(|place| !short.contains(place) || depth(place) <= 5.0));
            let reaches = |place: &DVec3| depth(*place) <= 5.5 && whole.touches(*place, 0.5);
            assert!(places().all(|place| short.touches(place, 0.5) == reaches(&place)));
        }
    }

    #[test]
    fn watchers_agree_with_asking_every_camera() {
        let cameras = cameras();
        let mut watchers = Watchers::new(&cameras);
        let is_wanted = |camera: &Camera| camera.cam_from_world.center().x > 0.0;
        for place in places() {
            assert_eq!(watchers.any(place, |_| true), cameras.iter().any(|camera| camera.sees(place)));
            let wanted = cameras.iter().any(|camera| camera.sees(place) && is_wanted(camera));
            assert_eq!(watchers.any(place, is_wanted), wanted);
        }
        assert!(!Watchers::new(&[]).any(DVec3::ZERO, |_| true));
    }
}
