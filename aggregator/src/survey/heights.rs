//! The heights of the surface below the pixels of a map.
//!
//! What it knows nothing about: files and colours.
//!
//! Where to start reading: [`find_heights`].

use cosurf_scene::{Camera, Caster, LocalFrame, Mesh};
use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::error::SurveyError;
use super::lattice::{Extent, Lattice, Window, two_digits};
use super::place::Column;
use super::tiles::Tiles;
use super::witnesses::Witnesses;

/// Long side of the pictures in which the depth of the surface is measured, px: some hundred rays for each camera.
const MEASURED_PX: u32 = 16;

/// A mesh, to be looked at from straight above.
#[derive(Debug)]
pub(super) struct Surface {
    caster: Caster,
    frame: LocalFrame,
    /// World height of the highest camera, metres: what lies above is no ground. Not of the lowest one, because a flight
    /// that follows the terrain has cameras in a valley that are lower than the hill beside it.
    pub(super) ceiling_m: f64,
    /// World height of the lowest camera, metres.
    pub(super) lowest_eye_m: f64,
    /// The vertices of the mesh that enough cameras see.
    pub(super) seen: Extent,
    /// For each vertex of the mesh: whether enough cameras see it.
    pub(super) is_seen: Vec<bool>,
    /// Length that a pixel of the cameras covers on the surface, metres, rounded to two digits: the median over the
    /// cameras.
    pub(super) gsd_m: f64,
}

/// What a map covers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Covered {
    /// Number of pixels with a height.
    pub(super) pixels: u64,
    /// Area of the ground below them, square metres, as on a plan.
    pub(super) area_m2: f64,
    /// Lowest and highest height, metres above the ellipsoid.
    pub(super) range_m: [f64; 2],
}

impl Surface {
    /// A mesh in `frame`, and cameras in the world.
    pub(super) fn of(
        mesh: &Mesh,
        frame: &LocalFrame,
        cameras: &[Camera],
        witnesses: &Witnesses,
    ) -> Result<Self, SurveyError> {
        let eyes = || cameras.iter().map(|camera| camera.cam_from_world.center().z);
        let ceiling_m = eyes().fold(f64::NEG_INFINITY, f64::max);
        let lowest_eye_m = eyes().fold(f64::INFINITY, f64::min);
        let all: Vec<usize> = (0..cameras.len()).collect();
        let world = |position: &[f32; 3]| frame.world_from_local(DVec3::from_array(position.map(f64::from)));
        let sees = |at: DVec3| at.z < ceiling_m && witnesses.see(&all, at);
        let is_seen: Vec<bool> = mesh.positions.par_iter().map(|position| sees(world(position))).collect();
        let of_seen = mesh.positions.iter().zip(&is_seen).filter(|(_, is_seen)| **is_seen);
        let places: Vec<DVec3> = of_seen.map(|(position, _)| world(position)).collect();
        let median_m = median(places.iter().map(|at| at.z).collect()).ok_or(SurveyError::NothingSeen)?;
        let caster = Caster::new(mesh);
        let covers = |camera: &Camera| covers_m(&caster, &frame.local_camera(camera));
        let gsd = median(cameras.iter().filter_map(covers).collect()).ok_or(SurveyError::NothingSeen)?;
        let gsd_m = two_digits(gsd * frame.unit());
        let seen = Extent { places, median_m };
        Ok(Self { caster, frame: *frame, ceiling_m, lowest_eye_m, seen, is_seen, gsd_m })
    }

    /// World height of the surface at a place, metres; `None` if there is none below the ceiling.
    fn height(&self, at: DVec2) -> Option<f64> {
        let from = self.frame.local_from_world(at.extend(self.ceiling_m));
        let height = self.caster.height_below(from)?;
        Some(self.frame.world_from_local(from.with_z(height)).z)
    }

    /// World height of the highest of nine points of the surface: one at this place and eight around it, `beside_m` to
    /// each side.
    pub(super) fn highest_near(&self, at: DVec2, beside_m: f64) -> Option<f64> {
        let around = (0..9).map(|i| DVec2::new(f64::from(i % 3) - 1.0, f64::from(i / 3) - 1.0) * beside_m);
        around.filter_map(|beside| self.height(at + beside)).reduce(f64::max)
    }
}

/// Length that a pixel covers on the surface, in the units of the frame: the median over the picture.
fn covers_m(caster: &Caster, camera: &Camera) -> Option<f64> {
    let depths = caster.cast(&camera.fitted(MEASURED_PX)).depth;
    let depth = median(depths.into_iter().filter(|depth| *depth > 0.0).map(f64::from).collect())?;
    Some(depth / (camera.focal_px.x * camera.focal_px.y).sqrt())
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Finds the ellipsoidal height at the centre of every pixel, metres; NaN where there is no surface that enough cameras
/// see. `on_tile` gets the number of tiles that are done, and of all.
pub(super) fn find_heights(
    surface: &Surface,
    witnesses: &Witnesses,
    lattice: &Lattice,
    heights: &mut Tiles<f32>,
    mut on_tile: impl FnMut(usize, usize),
) -> Result<Covered, SurveyError> {
    let mut covered = Covered { pixels: 0, area_m2: 0.0, range_m: [f64::INFINITY, f64::NEG_INFINITY] };
    for tile in 0..heights.len() {
        let window = heights.window(tile);
        let values = of_window(surface, witnesses, lattice, window)?;
        let [mut lowest_m, mut highest_m] = covered.range_m;
        let mut pixels = 0;
        for height in values.iter().filter(|height| !height.is_nan()) {
            pixels += 1;
            lowest_m = lowest_m.min(f64::from(*height));
            highest_m = highest_m.max(f64::from(*height));
        }
        let middle = DVec2::from([0, 1].map(|a| f64::from(window.at[a]) + 0.5 * f64::from(window.size[a])));
        let area_m2 = covered.area_m2 + pixels as f64 * lattice.pixel_area_m2(middle)?;
        covered = Covered { pixels: covered.pixels + pixels, area_m2, range_m: [lowest_m, highest_m] };
        heights.write(tile, &values)?;
        on_tile(tile + 1, heights.len());
    }
    Ok(covered)
}

fn of_window(
    surface: &Surface,
    witnesses: &Witnesses,
    lattice: &Lattice,
    window: Window,
) -> Result<Vec<f32>, SurveyError> {
    let columns = lattice.columns(window)?;
    let points: Vec<Option<DVec3>> = columns
        .par_iter()
        .with_min_len(1024)
        .map(|column| surface.height(column.at).map(|z| column.at.extend(z)))
        .collect();
    let bounds = points.iter().flatten().fold(None, |bounds: Option<(DVec3, DVec3)>, point| {
        let (low, high) = bounds.unwrap_or((*point, *point));
        Some((low.min(*point), high.max(*point)))
    });
    let Some((low, high)) = bounds else { return Ok(vec![f32::NAN; columns.len()]) };
    let among = witnesses.of_ball(0.5 * (low + high), 0.5 * low.distance(high));
    let height = |(column, point): (&Column, &Option<DVec3>)| match point {
        Some(point) if witnesses.see(&among, *point) => (point.z + column.lift_m) as f32,
        _ => f32::NAN,
    };
    Ok(columns.par_iter().zip(&points).with_min_len(1024).map(height).collect())
}
