//! How well the views agree: for each pixel of the map, how many views see its surface, and how far from it they do.
//!
//! Each view's depth is compared with the height that was found. A view whose depth is more than a few voxels away sees
//! something else there: in front of the surface, which says nothing about it; or behind it, and then looks through it.
//!
//! What it knows nothing about: files; how heights were found.
//!
//! Where to start reading: [`find_views`].

use bytemuck::{Pod, Zeroable};
use cosurf_scene::Frustum;
use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::depths::{DepthMap, Depths};
use super::error::SurveyError;
use super::lattice::Lattice;
use super::place::Column;
use super::tiles::Tiles;

/// A depth farther than this many voxels from the surface shows another surface: the fusion's truncation is as wide.
const SAME_VOXELS: f64 = 4.0;

/// The views of a pixel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Views {
    /// Number of views.
    pub(super) count: f32,
    /// Number of views that look through the surface: they show another one behind it.
    pub(super) through: f32,
    /// Sum of the squares of the differences between what views show and what was found, m²: of heights for pixels, of
    /// distances along the rays for splats.
    squares_m2: f32,
}

impl Views {
    /// Views with this spread, metres.
    #[cfg(test)]
    pub(super) fn of(count: f32, through: f32, spread_m: f32) -> Self {
        Self { count, through, squares_m2: count * spread_m * spread_m }
    }

    /// The root mean square of the differences, metres; `None` without a view.
    pub(super) fn spread_m(&self) -> Option<f32> {
        (self.count > 0.0).then(|| (self.squares_m2 / self.count).sqrt())
    }
}

/// Finds the views of all pixels, of a surface with voxels of `voxel_m`. `on_view` gets the number of views that are done,
/// and of all.
pub(super) fn find_views(
    mut depths: Depths,
    lattice: &Lattice,
    heights: &mut Tiles<f32>,
    views: &mut Tiles<Views>,
    voxel_m: f64,
    mut on_view: impl FnMut(usize, usize),
) -> Result<(), SurveyError> {
    let mut balls = Vec::with_capacity(heights.len());
    for tile in 0..heights.len() {
        let window = heights.window(tile);
        views.write(tile, &vec![Views::default(); window.pixels()])?;
        balls.push(ball(&lattice.columns(window)?, &heights.read(tile)?));
    }
    depths.each(|[done, of], map| {
        let frustum = Frustum::new(&map.camera);
        let picture = Picture::new(map, voxel_m);
        for (tile, ball) in balls.iter().enumerate() {
            let Some((center, radius_m)) = *ball else { continue };
            if frustum.touches(center, radius_m) {
                let columns = lattice.columns(heights.window(tile))?;
                let (heights, mut values) = (heights.read(tile)?, views.read(tile)?);
                let pixels = values.par_iter_mut().zip(columns.par_iter().zip(&heights));
                pixels
                    .with_min_len(4096)
                    .for_each(|(views, (column, height))| picture.add(views, column, *height));
                views.write(tile, &values)?;
            }
        }
        on_view(done, of);
        Ok(())
    })
}

/// A ball around the surface of a tile: its middle in the world, and its radius, metres. `None` without a surface.
fn ball(columns: &[Column], heights: &[f32]) -> Option<(DVec3, f64)> {
    let points = columns.iter().zip(heights).filter(|(_, height)| !height.is_nan());
    let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for (column, height) in points {
        let at = column.at.extend(f64::from(*height) - column.lift_m);
        (low, high) = (low.min(at), high.max(at));
    }
    low.cmple(high).all().then(|| (0.5 * (low + high), 0.5 * low.distance(high)))
}

/// What a camera of the world shows.
pub(super) struct Picture<'a> {
    map: &'a DepthMap,
    /// Largest difference of depths that show the same surface, metres.
    same_m: f64,
}

impl<'a> Picture<'a> {
    /// Compares a camera's depths with a surface that has voxels of `voxel_m`.
    pub(super) fn new(map: &'a DepthMap, voxel_m: f64) -> Self {
        Self { map, same_m: SAME_VOXELS * voxel_m }
    }

    /// Counts the picture if it shows the surface of a pixel.
    fn add(&self, views: &mut Views, column: &Column, height: f32) {
        if height.is_nan() {
            return;
        }
        self.add_point(views, column.at.extend(f64::from(height) - column.lift_m));
    }

    /// Counts the picture if it shows a point of the world, or looks through it. Differences are those of heights.
    pub(super) fn add_point(&self, views: &mut Views, at: DVec3) {
        self.add_along(views, at, |ray| ray.z);
    }

    /// As [`Self::add_point`] for the centre of a splat. Differences are distances along the rays: on a wall, heights say
    /// little about how far the splat is from the surface.
    pub(super) fn add_splat(&self, views: &mut Views, at: DVec3) {
        self.add_along(views, at, DVec3::length);
    }

    /// Counts the picture for a point. `extent_m` returns the length in metres, along the vector from the camera to
    /// the point, that differences are measured by: its height for pixels of the map, its full length for splats.
    fn add_along(&self, views: &mut Views, at: DVec3, extent_m: impl Fn(DVec3) -> f64) {
        let Some((px, depth_m)) = self.map.camera.project_with_depth(at) else { return };
        let Some(shown_m) = self.depth_m(px) else { return };
        if self.is_same(at, depth_m, shown_m) {
            // By how much the point that the picture shows is farther along the ray.
            let farther_m = (shown_m / depth_m - 1.0) * extent_m(at - self.eye());
            views.count += 1.0;
            views.squares_m2 += (farther_m * farther_m) as f32;
        } else if shown_m > depth_m {
            views.through += 1.0;
        }
    }

    /// Where the picture shows a point of the world, px, and its depth, metres; `None` if it does not.
    pub(super) fn shows(&self, at: DVec3) -> Option<(DVec2, f64)> {
        let (px, depth_m) = self.map.camera.project_with_depth(at)?;
        self.is_same(at, depth_m, self.depth_m(px)?).then_some((px, depth_m))
    }

    /// Where the picture was taken, in the world.
    pub(super) fn eye(&self) -> DVec3 {
        self.map.camera.cam_from_world.center()
    }

    /// Whether a point is on the surface that is shown, by their depths.
    fn is_same(&self, at: DVec3, depth_m: f64, shown_m: f64) -> bool {
        (shown_m - depth_m).abs() * self.eye().distance(at) / depth_m <= self.same_m
    }

    /// The depth at the nearest pixel, metres.
    fn depth_m(&self, px: DVec2) -> Option<f64> {
        let DepthMap { camera, depth_m, .. } = self.map;
        if !camera.contains(px) {
            return None;
        }
        let i = px.y as usize * camera.size_px[0] as usize + px.x as usize;
        depth_m.get(i).copied().map(f64::from).filter(|depth_m| *depth_m > 0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::above;

    #[test]
    fn views_count_where_they_show_the_surface() {
        let camera = above(0.0);
        let [width, height] = camera.size_px.map(|side| side as usize);
        let map = DepthMap { camera, depth_m: vec![9.9; width * height], rgb: Vec::new() };
        let picture = Picture { map: &map, same_m: 0.4 };
        // The camera is 10 m above the ground, so the picture shows a surface 0.1 m above it.
        let spread = |x: f64, height: f32| {
            let mut views = Views::default();
            picture.add(&mut views, &Column { at: DVec2::new(x, 0.0), lift_m: 70.0 }, height);
            views.spread_m()
        };
        assert!(spread(0.5, 70.0).is_some_and(|m| (m - 0.1).abs() < 1e-3));
        assert!(spread(0.5, 69.9).is_some_and(|m| (m - 0.2).abs() < 1e-3));
        assert_eq!([spread(0.5, 69.0), spread(0.5, f32::NAN), spread(40.0, 70.0)], [None; 3]);
        let through = |height: f32| {
            let mut views = Views::default();
            picture.add(&mut views, &Column { at: DVec2::new(0.5, 0.0), lift_m: 70.0 }, height);
            views.through
        };
        assert_eq!([through(71.0), through(70.0), through(69.0)], [1.0, 0.0, 0.0]);
    }
}
