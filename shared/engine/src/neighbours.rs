//! The neighbours of a view: other views that look in a similar direction. The baseline between two neighbours is long
//! enough to measure depth, and short enough that their pictures can be compared.

use cosurf_scene::{Camera, SparsePoint};

use crate::random::{Purpose, Random};

/// Largest number of neighbours of a view (PGSR).
const NEIGHBOURS_MAX: usize = 8;
/// Cosine of the largest angle between the optical axes of neighbours (PGSR: 30°).
const AXES_COSINE_MIN: f64 = 0.866_025_403_784_438_6;
/// Shortest baseline between neighbours, as a share of the median depth. The limits of PGSR are in scene units; with
/// them, views of aerial scenes in metres would have no neighbours.
const BASELINE_MIN: f64 = 0.02;
/// Longest baseline between neighbours, as a share of the median depth.
const BASELINE_MAX: f64 = 0.5;

/// Most points that tell the typical depth: without tracks, a point takes memory for each view that it lies in.
const TYPICAL_POINTS_MAX: usize = 10_000;

/// For each view, the views that it may be compared with, nearest first.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Neighbours(Vec<Vec<u32>>);

impl Neighbours {
    /// No view has neighbours.
    pub fn none() -> Self {
        Self::default()
    }

    /// Finds the neighbours of each camera among `cameras`. The median depth of the points that a view sees limits the
    /// baseline to its neighbours; a view that sees no points has none. [`SparsePoint::views`] are indices into
    /// `cameras`.
    pub fn find(cameras: &[Camera], points: &[SparsePoint]) -> Self {
        let depths = median_depths(cameras, points.iter());
        Self(
            depths
                .iter()
                .enumerate()
                .map(|(view, depth)| depth.map_or(Vec::new(), |d| nearest(cameras, view, d)))
                .collect(),
        )
    }

    /// The nearest neighbour of `view`, if it has any.
    pub fn nearest(&self, view: usize) -> Option<usize> {
        self.0.get(view)?.first().map(|other| *other as usize)
    }

    /// A random neighbour of `view` for a step, if it has any.
    pub(crate) fn draw(&self, view: usize, seed: u64, step: u32) -> Option<usize> {
        let candidates = self.0.get(view).filter(|candidates| !candidates.is_empty())?;
        let mut random = Random::new(seed, Purpose::Neighbour, u64::from(step), view as u64);
        Some(candidates[random.below(candidates.len() as u64) as usize] as usize)
    }
}

fn nearest(cameras: &[Camera], view: usize, depth: f64) -> Vec<u32> {
    let pose = |i: usize| cameras[i].cam_from_world;
    let (eye, forward) = (pose(view).center(), pose(view).forward());
    let mut found: Vec<(f64, u32)> = (0..cameras.len())
        .filter(|&other| other != view && forward.dot(pose(other).forward()) > AXES_COSINE_MIN)
        .map(|other| (eye.distance(pose(other).center()), other as u32))
        .filter(|(baseline, _)| (BASELINE_MIN * depth..=BASELINE_MAX * depth).contains(baseline))
        .collect();
    found.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    found.truncate(NEIGHBOURS_MAX);
    found.into_iter().map(|(_, other)| other).collect()
}

/// The typical depth of a scene, world units: for each view the median depth of the sparse points that it sees, and of these
/// the median; `None` if no view sees a point. If there are many points, a sample at even intervals is used.
/// [`SparsePoint::views`] are indices into `cameras`.
pub fn typical_depth(cameras: &[Camera], points: &[SparsePoint]) -> Option<f64> {
    let some = points.iter().step_by(points.len().div_ceil(TYPICAL_POINTS_MAX).max(1));
    median(median_depths(cameras, some).into_iter().flatten().collect())
}

/// For each view, the median depth of the sparse points that it sees; `None` if it sees none.
fn median_depths<'a>(cameras: &[Camera], points: impl Iterator<Item = &'a SparsePoint>) -> Vec<Option<f64>> {
    let mut depths: Vec<Vec<f64>> = vec![Vec::new(); cameras.len()];
    for point in points {
        let mut note = |view: usize| {
            let z = cameras[view].cam_from_world.transform(point.position).z;
            if z > 0.0 {
                depths[view].push(z);
            }
        };
        // Formats without tracks do not say which views see a point. Every view with the point inside its picture then
        // counts.
        if point.views.is_empty() {
            (0..cameras.len()).filter(|&view| cameras[view].sees(point.position)).for_each(&mut note);
        } else {
            point.views.iter().for_each(|&view| note(view as usize));
        }
    }
    depths.into_iter().map(median).collect()
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

#[cfg(test)]
mod tests {
    use super::*;
    use cosurf_scene::Pose;
    use glam::{DVec2, DVec3};

    /// Cameras 50 m above the ground that look down, at `places` in metres along a line; one more camera looks
    /// elsewhere.
    fn flight(places: &[f64]) -> (Vec<Camera>, Vec<SparsePoint>) {
        let looking = |x: f64, target: DVec3| Camera {
            cam_from_world: Pose::look_at(DVec3::new(x, 0.0, 50.0), target, DVec3::Y),
            focal_px: DVec2::splat(100.0),
            center_px: DVec2::splat(50.0),
            size_px: [100, 100],
        };
        let mut cameras: Vec<Camera> = places.iter().map(|&x| looking(x, DVec3::new(x, 0.0, 0.0))).collect();
        cameras.push(looking(5.0, DVec3::new(90.0, 0.0, 0.0)));
        let views: Vec<u32> = (0..cameras.len() as u32).collect();
        let points = (0..5).map(|i| SparsePoint {
            position: DVec3::new(f64::from(i), 1.0, 0.0),
            rgb: [0; 3],
            views: views.clone(),
        });
        (cameras, points.collect())
    }

    #[test]
    fn the_typical_depth_is_that_of_most_views() {
        let (cameras, mut points) = flight(&[0.0, 10.0, 20.0]);
        let is_50_m = |points: &[SparsePoint]| {
            typical_depth(&cameras, points).is_some_and(|depth| (depth - 50.0).abs() < 1e-9)
        };
        assert!(is_50_m(&points));
        points.iter_mut().for_each(|point| point.views.clear());
        let many: Vec<SparsePoint> =
            points.iter().cycle().take(3 * TYPICAL_POINTS_MAX + 1).cloned().collect();
        assert!(is_50_m(&many), "without tracks");
        assert_eq!(typical_depth(&cameras, &[]), None);
    }

    #[test]
    fn neighbours_are_near_but_not_too_near_and_look_in_a_similar_direction() {
        let (cameras, points) = flight(&[0.0, 0.5, 5.0, 20.0, 30.0]);
        let neighbours = Neighbours::find(&cameras, &points);
        // 0.5 m is too near, 30 m too far; the camera that looks elsewhere is no neighbour.
        assert_eq!(neighbours.0[0], [2, 3]);
        assert_eq!(neighbours.0[5], [0u32; 0]);
    }

    #[test]
    fn every_neighbour_is_drawn_and_a_step_always_draws_the_same_one() {
        let (cameras, points) = flight(&[0.0, 4.0, 8.0, 12.0]);
        let neighbours = Neighbours::find(&cameras, &points);
        let drawn: Vec<usize> = (0..60).filter_map(|step| neighbours.draw(0, 7, step)).collect();
        assert!([1, 2, 3].iter().all(|view| drawn.contains(view)));
        assert_eq!(neighbours.draw(0, 7, 11), neighbours.draw(0, 7, 11));
        assert_eq!(Neighbours::none().draw(0, 7, 0), None);
    }
}
