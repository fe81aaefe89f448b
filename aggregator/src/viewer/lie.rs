//! How a model lies in its frame, as its splats and cameras tell: its middle, its size, which way is up, and how finely and
//! how widely the photographs show the ground.
//!
//! What it knows nothing about: files and pages. Lengths are in the frame's unit.

use cosurf_scene::{Camera, Pose, Splats};
use glam::{DVec2, DVec3};

/// Number of splats whose positions are looked at.
const SAMPLE: usize = 10_000;
/// How much better than z another axis must be to count as up.
const PREFER_Z: f64 = 1.05;
/// Pitch of the overview, radians below the horizon; distance of its camera, in sizes of the model; half of the vertical
/// field of view, radians. Those of `walk.js`, so that the overview is the first thing that the viewer shows.
const OVERVIEW_PITCH: f64 = 0.7;
const OVERVIEW_DISTANCE: f64 = 1.3;
const HALF_FIELD: f64 = 0.45;

/// How a model lies in its frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Lie {
    /// Median of the splats' positions.
    center: DVec3,
    /// Largest side of the box that holds the middle four fifths of the splats along each axis.
    size: f64,
    /// Up direction, an axis.
    pub(super) up: DVec3,
    /// Median length on the ground that a pixel covers; absent if no camera looks at the ground.
    pub(super) pixel: Option<f64>,
    /// Area between the ground points that the photographs are centred on; absent if they lie on a line.
    pub(super) area: Option<f64>,
}

impl Lie {
    /// How splats and cameras of one frame lie. The world is known to have z up if it is georeferenced.
    pub(super) fn of(splats: &Splats, cameras: &[Camera], is_georeferenced: bool) -> Self {
        let up = if is_georeferenced { DVec3::Z } else { up_of(cameras) };
        let step = (splats.len() / SAMPLE).max(1);
        let ranges = [0, 1, 2].map(|axis| {
            let mut values: Vec<f32> = splats.means.iter().step_by(step).map(|mean| mean[axis]).collect();
            values.sort_unstable_by(f32::total_cmp);
            [0.1, 0.5, 0.9].map(|share| f64::from(values[(share * (values.len() - 1) as f64) as usize]))
        });
        let center = DVec3::from_array(ranges.map(|[_, middle, _]| middle));
        let size = ranges.iter().fold(1e-3, |size: f64, [low, _, high]| size.max(high - low));
        let hits: Vec<(DVec3, f64)> =
            cameras.iter().filter_map(|camera| ground_hit(camera, center, up)).collect();
        let mut pixels: Vec<f64> = hits.iter().map(|(_, pixel)| *pixel).collect();
        pixels.sort_unstable_by(f64::total_cmp);
        let (east, north) = ground_axes(up);
        let points = hits.iter().map(|(point, _)| DVec2::new(point.dot(east), point.dot(north))).collect();
        Self { center, size, up, pixel: pixels.get(pixels.len() / 2).copied(), area: hull_area(points) }
    }

    /// The camera of the overview: it looks at the whole model from the south.
    pub(super) fn overview(&self, size_px: [u32; 2]) -> Camera {
        let (_, north) = ground_axes(self.up);
        let along = north * OVERVIEW_PITCH.cos() - self.up * OVERVIEW_PITCH.sin();
        let eye = self.center - along * OVERVIEW_DISTANCE * self.size;
        let size = DVec2::new(f64::from(size_px[0]), f64::from(size_px[1]));
        Camera {
            cam_from_world: Pose::look_at(eye, self.center, self.up),
            focal_px: DVec2::splat(0.5 * size.y / HALF_FIELD.tan()),
            center_px: size / 2.0,
            size_px,
        }
    }
}

/// The axis that points up, as cameras tell: photographs have the sky above, or look down. Without cameras it is z.
pub(crate) fn up_of(cameras: &[Camera]) -> DVec3 {
    let score = |axis: DVec3| {
        let of_one = |camera: &Camera| {
            let to_world = camera.cam_from_world.rotation.inverse();
            (-(to_world * DVec3::Y).dot(axis)).max(-(to_world * DVec3::Z).dot(axis)).max(0.0)
        };
        cameras.iter().map(of_one).sum::<f64>()
    };
    let axes = [DVec3::NEG_Z, DVec3::Y, DVec3::NEG_Y, DVec3::X, DVec3::NEG_X];
    axes.into_iter()
        .fold(DVec3::Z, |best, axis| if score(axis) > PREFER_Z * score(best) { axis } else { best })
}

/// Two axes of the ground: with z up, x and y.
pub(crate) fn ground_axes(up: DVec3) -> (DVec3, DVec3) {
    let north = if up.y.abs() > 0.5 { DVec3::Z * -up.y } else { DVec3::Y };
    (north.cross(up), north)
}

/// The point of the ground, a plane through `center`, in the middle of a camera's picture, and the length that a pixel
/// covers across the line of sight there. `None` if the camera does not look down on it.
fn ground_hit(camera: &Camera, center: DVec3, up: DVec3) -> Option<(DVec3, f64)> {
    let (eye, along) = (camera.cam_from_world.center(), camera.cam_from_world.forward());
    let distance = (eye - center).dot(up) / -along.dot(up);
    let is_there = distance.is_finite() && distance > 0.0 && along.dot(up) < 0.0;
    is_there.then(|| (eye + along * distance, distance / camera.focal_px.x))
}

/// Area of the convex hull of points (Andrew's monotone chain); `None` if they lie on a line.
fn hull_area(mut points: Vec<DVec2>) -> Option<f64> {
    points.sort_unstable_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
    let chain = |points: &mut dyn Iterator<Item = DVec2>| {
        let mut hull: Vec<DVec2> = Vec::new();
        for point in points {
            while let [.., a, b] = hull[..]
                && (b - a).perp_dot(point - a) <= 0.0
            {
                hull.pop();
            }
            hull.push(point);
        }
        hull
    };
    let mut hull = chain(&mut points.iter().copied());
    hull.extend(chain(&mut points.iter().rev().copied()));
    let next = hull.iter().skip(1).chain(hull.first());
    let area = hull.iter().zip(next).map(|(a, b)| a.perp_dot(*b)).sum::<f64>() / 2.0;
    (area > 0.0).then_some(area)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{above, ground};

    #[test]
    fn cameras_tell_which_way_is_up() {
        let looking = |eye: DVec3, target: DVec3, up: DVec3| Camera {
            cam_from_world: Pose::look_at(eye, target, up),
            ..above(0.0)
        };
        let ahead = looking(DVec3::ZERO, DVec3::new(1.0, 0.2, 0.0), DVec3::NEG_Y);
        let down = looking(DVec3::NEG_Y * 9.0, DVec3::ZERO, DVec3::X);
        assert_eq!(up_of(&[ahead, down, ahead]), DVec3::NEG_Y);
        assert_eq!(up_of(&[above(0.0), above(1.0)]), DVec3::Z);
        assert_eq!(up_of(&[]), DVec3::Z);
    }

    #[test]
    fn the_overview_has_the_middle_in_its_middle() {
        let model = ground(0.0, 100.0);
        let lie = Lie::of(&model, &[above(10.0), above(50.0)], true);
        let camera = lie.overview([200, 100]);
        let at = camera.project(lie.center).map(|at| (at - DVec2::new(100.0, 50.0)).length());
        assert!(at.is_some_and(|distance| distance < 1e-6), "{at:?}");
        let pixel = lie.pixel.unwrap_or(0.0);
        let expected = (above(10.0).cam_from_world.center().z - lie.center.z) / above(10.0).focal_px.x;
        assert!((pixel / expected - 1.0).abs() < 0.2, "{pixel} {expected}");
        assert_eq!(lie.area, None, "two photographs enclose no area");
    }

    #[test]
    fn the_hull_of_a_square_has_its_area() {
        let points = [[0.0, 0.0], [2.0, 0.0], [1.0, 1.0], [2.0, 2.0], [0.0, 2.0], [1.0, 0.0]];
        assert_eq!(hull_area(points.map(DVec2::from_array).to_vec()), Some(4.0));
        assert_eq!(hull_area(vec![DVec2::ZERO, DVec2::X, DVec2::X * 2.0]), None);
        assert_eq!(hull_area(Vec::new()), None);
    }
}
