//! The heights of the surface below the pixels of a map.
//!
//! What it knows nothing about: files and colours.
//!
//! Where to start reading: [`find_heights`].

use std::collections::HashMap;

use cosurf_scene::{Camera, Caster, LocalFrame, Mesh};
use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::error::SurveyError;
use super::lattice::{Extent, Lattice, Window, two_digits};
use super::parts::part;
use super::place::{Column, Place};
use super::quadtree::Quadtree;
use super::tiles::Tiles;
use super::witnesses::Witnesses;

/// Long side of the pictures in which the depth of the surface is measured, px: some hundred pixels for each camera.
const MEASURED_PX: u32 = 16;
/// Medians are those of about this many vertices.
const SAMPLES: usize = 20_000;
/// Side of the squares of a tile that are worked on at once, px: fewer triangles at a time take less memory.
const SQUARE_PX: u32 = 256;

/// What of a mesh is ground that enough cameras see, and where.
#[derive(Debug)]
pub(super) struct Ground {
    /// World height of the highest camera, metres: what lies above is no ground. Not of the lowest one, because a flight
    /// that follows the terrain has cameras in a valley that are lower than the hill beside it.
    pub(super) ceiling_m: f64,
    /// For each vertex of the mesh: whether enough cameras see it.
    pub(super) is_seen: Vec<bool>,
    /// Where these vertices are.
    pub(super) extent: Extent,
    /// Length that a pixel of the cameras covers on the surface, metres, rounded to two digits: the median over the
    /// cameras.
    pub(super) gsd_m: f64,
}

/// A mesh, to be looked at from straight above.
pub(super) struct Surface<'a> {
    pub(super) mesh: &'a Mesh,
    /// Its triangles that enough cameras see.
    pub(super) tree: &'a Quadtree,
    /// The frame that it is in.
    pub(super) frame: &'a LocalFrame,
    /// World height above which there is no ground, metres.
    pub(super) ceiling_m: f64,
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

impl Covered {
    /// Of a map; `None` if no pixel has a height.
    pub(super) fn of(lattice: &Lattice, heights: &mut Tiles<f32>) -> Result<Option<Self>, SurveyError> {
        let mut covered = Self { pixels: 0, area_m2: 0.0, range_m: [f64::INFINITY, f64::NEG_INFINITY] };
        for tile in 0..heights.len() {
            let (window, values) = (heights.window(tile), heights.read(tile)?);
            let [mut lowest_m, mut highest_m] = covered.range_m;
            let mut pixels = 0;
            for height in values.iter().filter(|height| !height.is_nan()) {
                pixels += 1;
                lowest_m = lowest_m.min(f64::from(*height));
                highest_m = highest_m.max(f64::from(*height));
            }
            let middle =
                DVec2::from([0, 1].map(|a| f64::from(window.at[a]) + 0.5 * f64::from(window.size[a])));
            let area_m2 = covered.area_m2 + pixels as f64 * lattice.pixel_area_m2(middle)?;
            covered = Self { pixels: covered.pixels + pixels, area_m2, range_m: [lowest_m, highest_m] };
        }
        Ok((covered.pixels > 0).then_some(covered))
    }
}

impl Ground {
    /// Of a mesh in `frame`, and cameras in the world.
    pub(super) fn of(
        mesh: &Mesh,
        frame: &LocalFrame,
        cameras: &[Camera],
        witnesses: &Witnesses,
        place: &Place,
    ) -> Result<Self, SurveyError> {
        let ceiling_m =
            cameras.iter().map(|camera| camera.cam_from_world.center().z).fold(f64::NEG_INFINITY, f64::max);
        let all: Vec<usize> = (0..cameras.len()).collect();
        let world = |position: &[f32; 3]| frame.world_from_local(position.map(f64::from).into());
        let sees = |at: DVec3| at.z < ceiling_m && witnesses.see(&all, at);
        let is_seen: Vec<bool> = mesh.positions.par_iter().map(|position| sees(world(position))).collect();
        let seen =
            || mesh.positions.iter().zip(&is_seen).filter(|(_, is_seen)| **is_seen).map(|(at, _)| world(at));
        let (mut low, mut high, mut count) = (DVec2::INFINITY, DVec2::NEG_INFINITY, 0);
        for at in seen() {
            let map = place.map_from_enu(at)?.truncate();
            (low, high, count) = (low.min(map), high.max(map), count + 1);
        }
        let sample: Vec<DVec3> = seen().step_by(count / SAMPLES + 1).collect();
        let median_m = median(sample.iter().map(|at| at.z).collect()).ok_or(SurveyError::NothingSeen)?;
        let covers = |camera: &Camera| covers_m(camera, &sample);
        let gsd_m = median(cameras.iter().filter_map(covers).collect()).ok_or(SurveyError::NothingSeen)?;
        Ok(Self { ceiling_m, is_seen, extent: Extent { low, high, median_m }, gsd_m: two_digits(gsd_m) })
    }
}

impl Surface<'_> {
    /// The triangles around some columns, ready for [`Self::height`].
    fn caster(&self, columns: &[Column]) -> Option<Caster> {
        let local = |column: &Column| self.frame.local_from_world(column.at.extend(0.0)).truncate();
        let low = columns.iter().map(local).fold(DVec2::INFINITY, DVec2::min);
        let high = columns.iter().map(local).fold(DVec2::NEG_INFINITY, DVec2::max);
        let triangles = self.tree.touching(self.mesh, low, high);
        (!triangles.is_empty()).then(|| Caster::new(&part(self.mesh, &triangles)))
    }

    /// World height of the surface at a place, metres; `None` if there is none below the ceiling.
    fn height(&self, caster: &Caster, at: DVec2) -> Option<f64> {
        let from = self.frame.local_from_world(at.extend(self.ceiling_m));
        let height = caster.height_below(from)?;
        Some(self.frame.world_from_local(from.with_z(height)).z)
    }
}

/// Length that a pixel covers on the surface, metres: the median over a coarse picture in which each pixel shows the
/// nearest of these places.
fn covers_m(camera: &Camera, places: &[DVec3]) -> Option<f64> {
    let small = camera.fitted(MEASURED_PX);
    let mut depths: HashMap<[u32; 2], f64> = HashMap::new();
    for at in places {
        if let Some((px, depth)) = small.project_with_depth(*at).filter(|(px, _)| small.contains(*px)) {
            let nearest = depths.entry([px.x as u32, px.y as u32]).or_insert(depth);
            *nearest = nearest.min(depth);
        }
    }
    let depth = median(depths.into_values().collect())?;
    Some(depth / (camera.focal_px.x * camera.focal_px.y).sqrt())
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Finds the ellipsoidal height at the centre of every pixel, metres; NaN where there is no surface that enough cameras
/// see. Returns whether there is any. `on_tile` gets the number of tiles that are done, and of all.
pub(super) fn find_heights(
    surface: &Surface,
    witnesses: &Witnesses,
    lattice: &Lattice,
    heights: &mut Tiles<f32>,
    mut on_tile: impl FnMut(usize, usize),
) -> Result<bool, SurveyError> {
    let mut has_any = false;
    for tile in 0..heights.len() {
        let values = of_tile(surface, witnesses, lattice, heights.window(tile))?;
        has_any |= values.iter().any(|height| !height.is_nan());
        heights.write(tile, &values)?;
        on_tile(tile + 1, heights.len());
    }
    Ok(has_any)
}

fn of_tile(
    surface: &Surface,
    witnesses: &Witnesses,
    lattice: &Lattice,
    tile: Window,
) -> Result<Vec<f32>, SurveyError> {
    let mut all = vec![f32::NAN; tile.pixels()];
    for y in (0..tile.size[1]).step_by(SQUARE_PX as usize) {
        for x in (0..tile.size[0]).step_by(SQUARE_PX as usize) {
            let size = [(tile.size[0] - x).min(SQUARE_PX), (tile.size[1] - y).min(SQUARE_PX)];
            let square = Window { at: [tile.at[0] + x, tile.at[1] + y], size };
            let heights = of_square(surface, witnesses, lattice, square)?;
            for (row, heights) in heights.chunks(size[0] as usize).enumerate() {
                let first = (y as usize + row) * tile.size[0] as usize + x as usize;
                all[first..first + heights.len()].copy_from_slice(heights);
            }
        }
    }
    Ok(all)
}

fn of_square(
    surface: &Surface,
    witnesses: &Witnesses,
    lattice: &Lattice,
    window: Window,
) -> Result<Vec<f32>, SurveyError> {
    let columns = lattice.columns(window)?;
    let Some(caster) = surface.caster(&columns) else { return Ok(vec![f32::NAN; columns.len()]) };
    let points: Vec<Option<DVec3>> = columns
        .par_iter()
        .with_min_len(1024)
        .map(|column| surface.height(&caster, column.at).map(|z| column.at.extend(z)))
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
