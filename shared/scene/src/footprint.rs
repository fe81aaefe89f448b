//! Finds the ground that each view sees, in map coordinates. By it, views are divided among devices.
//!
//! The dataset does not say which axis is up. The up axis is the world axis along which the sparse points
//! spread least, directed towards the cameras. Without sparse points, it is the positive axis along which
//! the camera positions spread least. The centre of a footprint is the median of the sparse points that the
//! view sees. The median is robust against outliers and against background up to the horizon. If a view sees
//! too few points, the centre is where its optical axis meets the ground.

use crate::{Camera, Dataset, View};
use glam::{DVec2, DVec3};

/// Least number of points whose median gives the centre of a footprint.
const POINTS_MIN: usize = 8;
/// A ray is followed sideways for at most this many times the camera's height above the ground. Rays near
/// the horizon would meet the ground far outside the scene, or never.
const REACH_HEIGHTS: f64 = 3.0;

/// The ground as a horizontal plane, with map coordinates on it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ground {
    /// World directions of the first map coordinate, of the second map coordinate, and of up. Each is an
    /// axis of the world or its opposite, and together they are right-handed.
    axes: [DVec3; 3],
    /// Height of the ground along the up axis, world units; `None` without sparse points.
    height_m: Option<f64>,
}

/// The ground that a view sees, in map coordinates.
#[derive(Clone, Debug, PartialEq)]
pub struct Footprint {
    /// The centre of the ground that the view sees.
    pub center: DVec2,
    /// Where the rays through the picture's corners meet the ground, or are cut off (see [`REACH_HEIGHTS`]), in
    /// order around the picture.
    pub outline: [DVec2; 4],
}

impl Ground {
    /// Finds the up axis of a dataset and the height of the ground.
    pub fn of(dataset: &Dataset) -> Self {
        let eyes: Vec<DVec3> = dataset.views.iter().map(|v| v.camera.cam_from_world.center()).collect();
        let points: Vec<DVec3> = dataset.points.iter().map(|p| p.position).collect();
        let cloud = if points.is_empty() { &eyes } else { &points };
        Self::along(dataset, axis_of_least_spread(cloud))
    }

    /// The same for a dataset whose vertical axis is known, as 0, 1 or 2 for x, y or z.
    pub fn along(dataset: &Dataset, vertical: usize) -> Self {
        let eyes = dataset.views.iter().map(|view| view.camera.cam_from_world.center());
        let points = dataset.points.iter().map(|point| point.position);
        let height = median(points.map(|p| p[vertical]).collect());
        let eye_height = median(eyes.map(|p| p[vertical]).collect());
        let below = matches!((height, eye_height), (Some(ground), Some(eye)) if eye < ground);
        let axis = |i: usize| DVec3::AXES[(vertical + i) % 3];
        let axes = if below { [axis(2), axis(1), -axis(0)] } else { [axis(1), axis(2), axis(0)] };
        Self { axes, height_m: height.map(|h| if below { -h } else { h }) }
    }

    /// Map coordinates of a world point.
    pub fn map(&self, p_world: DVec3) -> DVec2 {
        DVec2::new(self.axes[0].dot(p_world), self.axes[1].dot(p_world))
    }

    /// Map position where a ray from `eye` meets the ground, or where [`REACH_HEIGHTS`] cuts it off. If the
    /// ground's height is unknown or not below `eye`, it is the map position of `eye`.
    fn meet(&self, eye: DVec3, direction: DVec3) -> DVec2 {
        let from = self.map(eye);
        let above = self.height_m.map_or(0.0, |ground| self.axes[2].dot(eye) - ground);
        if above <= 0.0 {
            return from;
        }
        let sideways = self.map(direction);
        let descent = -self.axes[2].dot(direction);
        let reach = REACH_HEIGHTS * above;
        if descent > 0.0 && sideways.length() * above <= reach * descent {
            return from + sideways * (above / descent);
        }
        from + sideways.normalize_or_zero() * reach
    }

    fn outline(&self, camera: &Camera) -> [DVec2; 4] {
        let [width, height] = camera.size_px.map(f64::from);
        let pose = &camera.cam_from_world;
        [[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]].map(|corner_px| {
            let ray_world = pose.rotation.inverse() * camera.ray(DVec2::from(corner_px));
            self.meet(pose.center(), ray_world)
        })
    }
}

/// The footprints of all views of a dataset, in their order.
pub fn footprints(dataset: &Dataset, ground: &Ground) -> Vec<Footprint> {
    let mut seen: Vec<Vec<DVec2>> = vec![Vec::new(); dataset.views.len()];
    for point in &dataset.points {
        let at = ground.map(point.position);
        for &view in &point.views {
            seen[view as usize].push(at);
        }
    }
    let footprint = |(view, seen): (&View, Vec<DVec2>)| {
        let pose = &view.camera.cam_from_world;
        let center = middle(&seen).unwrap_or_else(|| ground.meet(pose.center(), pose.forward()));
        Footprint { center, outline: ground.outline(&view.camera) }
    };
    dataset.views.iter().zip(seen).map(footprint).collect()
}

/// The median of each coordinate; `None` for fewer than [`POINTS_MIN`] points.
fn middle(points: &[DVec2]) -> Option<DVec2> {
    if points.len() < POINTS_MIN {
        return None;
    }
    let x = median(points.iter().map(|p| p.x).collect())?;
    let y = median(points.iter().map(|p| p.y).collect())?;
    Some(DVec2::new(x, y))
}

/// The axis with the smallest interquartile range, as 0, 1 or 2 for x, y or z. On a tie, z comes before y, and
/// y before x.
fn axis_of_least_spread(points: &[DVec3]) -> usize {
    let spread = |axis: usize| {
        let mut along: Vec<f64> = points.iter().map(|p| p[axis]).collect();
        along.sort_unstable_by(f64::total_cmp);
        let quartile = |q: usize| along.get(along.len() * q / 4).copied().unwrap_or(0.0);
        quartile(3) - quartile(1)
    };
    [2, 1, 0].into_iter().min_by(|&a, &b| spread(a).total_cmp(&spread(b))).unwrap_or(2)
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use crate::{Pose, SparsePoint};

    use super::*;

    fn camera(eye: DVec3, target: DVec3, up: DVec3) -> Camera {
        Camera {
            cam_from_world: Pose::look_at(eye, target, up),
            focal_px: DVec2::splat(100.0),
            center_px: DVec2::new(50.0, 50.0),
            size_px: [100, 100],
        }
    }

    fn dataset(cameras: Vec<Camera>, points: Vec<(DVec3, Vec<u32>)>) -> Dataset {
        let view = |(i, camera)| View { name: format!("{i}.jpg"), camera, path: "x".into(), mask: None };
        let point = |(position, views)| SparsePoint { position, rgb: [0; 3], views };
        Dataset {
            views: cameras.into_iter().enumerate().map(view).collect(),
            points: points.into_iter().map(point).collect(),
        }
    }

    /// A field of 21 × 21 points, a metre apart and seen by `views`. Their heights are 5.0 to 5.2 m.
    /// `place` turns east, north and up into a world position.
    fn field(place: impl Fn(f64, f64, f64) -> DVec3, views: &[u32]) -> Vec<(DVec3, Vec<u32>)> {
        let grid = (-10..=10).flat_map(|x| (-10..=10).map(move |y| (x, y)));
        grid.map(|(x, y)| {
            let rough = f64::from((x * 7 + y * 3) % 3) * 0.1;
            (place(f64::from(x), f64::from(y), 5.0 + rough), views.to_vec())
        })
        .collect()
    }

    #[test]
    fn a_nadir_view_without_points_of_its_own_looks_straight_down() {
        let eye = DVec3::new(3.0, 4.0, 25.0);
        let points = field(DVec3::new, &[]);
        let data = dataset(vec![camera(eye, eye - DVec3::Z, DVec3::Y)], points);
        let ground = Ground::of(&data);
        let print = &footprints(&data, &ground)[0];
        assert!((print.center - DVec2::new(3.0, 4.0)).length() < 1e-9, "{print:?}");
        // The camera is 20 m above the ground. Half the picture's width is half the focal length, so the view
        // reaches 10 m to each side. The first corner is the north-western one.
        let first = print.outline[0] - DVec2::new(-7.0, 14.0);
        assert!(first.abs().max_element() < 0.15, "{print:?}");
    }

    #[test]
    fn the_center_is_the_median_of_the_points_seen_and_ignores_outliers() {
        let eye = DVec3::new(3.0, 4.0, 25.0);
        let mut points = field(DVec3::new, &[]);
        points.extend((0..9).map(|_| (DVec3::new(7.0, -2.0, 5.0), vec![0])));
        points.extend((0..4).map(|_| (DVec3::new(9e5, 9e5, 5.0), vec![0])));
        let data = dataset(vec![camera(eye, eye - DVec3::Z, DVec3::Y)], points);
        let print = &footprints(&data, &Ground::of(&data))[0];
        assert_eq!(print.center, DVec2::new(7.0, -2.0));
    }

    #[test]
    fn a_ray_towards_the_horizon_is_cut_off() {
        let eye = DVec3::new(0.0, 0.0, 25.0);
        let data = dataset(vec![camera(eye, eye + DVec3::X, DVec3::Z)], field(DVec3::new, &[]));
        let print = &footprints(&data, &Ground::of(&data))[0];
        assert!((print.center.x - 3.0 * 20.0).abs() < 1.0 && print.center.y.abs() < 1e-9, "{print:?}");
    }

    #[test]
    fn a_world_whose_up_is_minus_y_is_mapped_from_above() {
        // COLMAP without georeference: y points down. East is x, so north must be z.
        let points = field(|east, north, up| DVec3::new(east, -up, north), &[]);
        let eye = DVec3::new(2.0, -25.0, 3.0);
        let data = dataset(vec![camera(eye, eye + DVec3::Y, DVec3::Z)], points);
        let ground = Ground::of(&data);
        let center = footprints(&data, &ground)[0].center;
        let (east, north) = (ground.map(DVec3::X), ground.map(DVec3::Z));
        assert_eq!(east.perp_dot(north), 1.0, "a map, not its mirror image: {ground:?}");
        assert!((center - (east * 2.0 + north * 3.0)).length() < 1e-9, "{center}");
    }

    /// Devices of one site must agree on the map, though each sees another part of the site.
    #[test]
    fn a_facade_does_not_change_a_vertical_axis_that_is_known() {
        let eyes = [DVec3::new(0.0, -30.0, 9.0), DVec3::new(5.0, -30.0, 12.0)];
        let wall = (0..400).map(|i| (DVec3::new(f64::from(i % 20), 0.0, f64::from(i / 20)), vec![0, 1]));
        let data = dataset(eyes.map(|eye| camera(eye, eye + DVec3::Y, DVec3::Z)).to_vec(), wall.collect());
        let at = DVec3::new(3.0, 4.0, 5.0);
        assert_eq!(Ground::along(&data, 2).map(at), DVec2::new(3.0, 4.0));
        assert_ne!(Ground::of(&data).map(at), DVec2::new(3.0, 4.0), "the wall spreads least along y");
    }

    #[test]
    fn without_any_points_the_center_is_below_the_camera() {
        let eyes = [DVec3::new(0.0, 0.0, 9.0), DVec3::new(5.0, 7.0, 9.0)];
        let cameras = eyes.map(|eye| camera(eye, eye - DVec3::Z, DVec3::Y)).to_vec();
        let data = dataset(cameras, Vec::new());
        let prints = footprints(&data, &Ground::of(&data));
        assert_eq!(prints[1].center - prints[0].center, DVec2::new(5.0, 7.0));
    }
}
