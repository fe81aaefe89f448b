//! The colours of a true orthophoto: the splats as they look from straight above every pixel.
//!
//! The renderer has pinhole cameras only, so each tile is rendered from a camera very far above it, with a long focal
//! length. How far is a compromise. In a tile of 512 px with a camera at distance D, what lies h above the plane of
//! reference shows up to 362 px · h / D too far outwards. But depths are `f32`: from 30 km on, they are multiples of 2 mm,
//! which still orders splats correctly; at the 110 km at which 3 m of relief would move by less than 0.01 px, multiples of
//! 8 mm, which do not.
//! So the camera is 30 km away, where a roof 20 m above the plane shows up to 0.24 px outwards, and each pixel looks up its
//! colour where its own height shows. What is left is that walls, too, are seen at that angle: 0.6 milliradians at most
//! with pixels of 0.05 m.
//!
//! What it knows nothing about: how the file of splats came to be.
//!
//! Where to start reading: [`Painter::paint`].

use std::path::Path;

use cosurf_engine::{Place, Rendering, ViewError, ViewMemory, Views};
use cosurf_geo::GeoError;
use cosurf_scene::{Camera, LocalFrame, Pose};
use glam::{DVec2, DVec3};

use super::error::SurveyError;
use super::lattice::{Lattice, TILE_PX, Window};
use super::place::Column;
use super::tiles::{Tiles, copy};

/// How far the cameras are above the surface, metres; the reason is above.
const ABOVE_M: f64 = 30_000.0;
/// Pixels that are rendered around a window, for what shows up outwards; enough for 600 m of relief.
const MARGIN_PX: u32 = 8;
/// Least side of a window, px. Smaller ones would be mostly margin.
const SIDE_LEAST_PX: u32 = 64;
/// Bytes per pixel beside a rendering: its column, height and colour.
const BYTES_PER_PIXEL: u64 = (size_of::<Column>() + size_of::<f32>() + size_of::<[u8; 4]>()) as u64;
/// Bytes for the heights and colours of a tile.
const TILE_BYTES: u64 = (TILE_PX * TILE_PX) as u64 * (size_of::<f32>() + size_of::<[u8; 4]>()) as u64;
/// Below this alpha the splats show too little to have a colour.
const ALPHA_LEAST: f32 = 0.1;

/// Renders splats from above.
pub(super) struct Painter<'a> {
    /// A PLY whose coordinates are those of `frame`.
    pub(super) splats: &'a Path,
    pub(super) frame: LocalFrame,
    /// Limit on the memory of the process, bytes.
    pub(super) memory_bytes: u64,
    /// Number of threads, at least 1.
    pub(super) threads: usize,
}

/// What is rendered at once.
struct Shot {
    window: Window,
    /// In the world.
    camera: Camera,
    /// World height at which the camera's pixels are those of the window, metres.
    plane_m: f64,
}

impl Painter<'_> {
    /// Renders the colours of all pixels: red, green, blue, and 255 where there is a height and a colour. Pixels beyond
    /// have colours too if they are in a window that has any, so that the overviews are not dark at the edge of the map.
    /// `on_tile` gets the number of tiles that are done, and of all. A tile whose splats do not fit into the memory is
    /// rendered in smaller windows, as are all others then.
    pub(super) fn paint(
        &self,
        lattice: &Lattice,
        heights: &mut Tiles<f32>,
        colors: &mut Tiles<[u8; 4]>,
        mut on_tile: impl FnMut(usize, usize),
    ) -> Result<(), SurveyError> {
        let mut side_px = TILE_PX;
        loop {
            match self.paint_windows(lattice, heights, colors, side_px, &mut on_tile)? {
                Err(ViewError::TooLittleMemory { .. }) if side_px > SIDE_LEAST_PX => side_px /= 2,
                done => return Ok(done?),
            }
        }
    }

    /// Paints in windows with this side. The inner error is that of a picture.
    fn paint_windows(
        &self,
        lattice: &Lattice,
        heights: &mut Tiles<f32>,
        colors: &mut Tiles<[u8; 4]>,
        side_px: u32,
        mut on_tile: impl FnMut(usize, usize),
    ) -> Result<Result<(), ViewError>, SurveyError> {
        let mut shots = Vec::with_capacity(heights.len());
        for tile in 0..heights.len() {
            shots.push(shots_of(lattice, heights.window(tile), &heights.read(tile)?, side_px)?);
        }
        let mut views = self.open(shots.iter().flatten())?;
        for (tile, shots) in shots.into_iter().enumerate() {
            let window = heights.window(tile);
            let (values, mut painted) = (heights.read(tile)?, vec![[0; 4]; window.pixels()]);
            for shot in shots {
                let rendering = match views.render(&self.frame.local_camera(&shot.camera)) {
                    Ok(rendering) => rendering,
                    Err(error) => return Ok(Err(error)),
                };
                let colors = shot.colors(lattice, &part(&values, window, shot.window), &rendering)?;
                copy(&colors, shot.window, &mut painted, window);
            }
            colors.write(tile, &painted)?;
            on_tile(tile + 1, heights.len());
        }
        Ok(Ok(()))
    }

    fn open<'b>(&self, shots: impl Iterator<Item = &'b Shot>) -> Result<Views, SurveyError> {
        let memory = ViewMemory {
            limit_bytes: self.memory_bytes,
            held_bytes: || 0,
            made_bytes: TILE_BYTES,
            made_bytes_per_pixel: BYTES_PER_PIXEL,
        };
        let world = LocalFrame::WORLD;
        let mut views = Views::open(self.splats.into(), &world, Place::Within(memory), self.threads)?;
        views.expect(shots.map(|shot| self.frame.local_camera(&shot.camera)).collect());
        Ok(views)
    }
}

/// What to render for a tile, from its heights: its parts with this side that have any.
fn shots_of(lattice: &Lattice, tile: Window, heights: &[f32], side_px: u32) -> Result<Vec<Shot>, GeoError> {
    let mut shots = Vec::new();
    for y in (0..tile.size[1]).step_by(side_px as usize) {
        for x in (0..tile.size[0]).step_by(side_px as usize) {
            let size = [side_px.min(tile.size[0] - x), side_px.min(tile.size[1] - y)];
            let window = Window { at: [tile.at[0] + x, tile.at[1] + y], size };
            shots.extend(Shot::of(lattice, window, &part(heights, tile, window))?);
        }
    }
    Ok(shots)
}

/// The values of a part of a tile.
fn part(values: &[f32], tile: Window, window: Window) -> Vec<f32> {
    let mut part = vec![0.0; window.pixels()];
    copy(values, tile, &mut part, window);
    part
}

/// World height of a pixel, metres; not a number where it has none.
fn z_of((column, height): (&Column, &f32)) -> f64 {
    f64::from(*height) - column.lift_m
}

impl Shot {
    /// `None` if no pixel has a height.
    fn of(lattice: &Lattice, window: Window, heights: &[f32]) -> Result<Option<Self>, GeoError> {
        let columns = lattice.columns(window)?;
        let mut range_m = [f64::INFINITY, f64::NEG_INFINITY];
        for z in columns.iter().zip(heights).map(z_of).filter(|z| !z.is_nan()) {
            range_m = [range_m[0].min(z), range_m[1].max(z)];
        }
        if range_m[0] > range_m[1] {
            return Ok(None);
        }
        let plane_m = 0.5 * (range_m[0] + range_m[1]);
        Ok(Some(Self { window, camera: camera_above(lattice, window, plane_m)?, plane_m }))
    }

    /// The colours of the window's pixels.
    fn colors(
        &self,
        lattice: &Lattice,
        heights: &[f32],
        rendering: &Rendering,
    ) -> Result<Vec<[u8; 4]>, GeoError> {
        let color = |(column, height): (&Column, &f32)| {
            let z = z_of((column, height));
            let point = column.at.extend(if z.is_nan() { self.plane_m } else { z });
            let [red, green, blue] = self.camera.project(point).and_then(|px| look_up(rendering, px))?;
            Some([red, green, blue, if z.is_nan() { 0 } else { 255 }])
        };
        let columns = lattice.columns(self.window)?;
        Ok(columns.iter().zip(heights).map(|both| color(both).unwrap_or([0; 4])).collect())
    }
}

/// A camera far above a window and its margin, whose pixels have the size of the window's on the plane z = `plane_m`.
fn camera_above(lattice: &Lattice, window: Window, plane_m: f64) -> Result<Camera, GeoError> {
    let half = DVec2::from(window.size.map(|side| 0.5 * f64::from(side)));
    let middle = DVec2::from(window.at.map(f64::from)) + half;
    let column = |px: DVec2| lattice.place().column(lattice.map_from_px(px), plane_m);
    let across = |step: DVec2| -> Result<DVec2, GeoError> {
        Ok((column(middle + step)?.at - column(middle - step)?.at) / (2.0 * step.length()))
    };
    let (east, south) = (across(DVec2::X * half.x)?, across(DVec2::Y * half.y)?);
    let eye = column(middle)?.at.extend(plane_m + ABOVE_M);
    let size_px = window.size.map(|side| side + 2 * MARGIN_PX);
    Ok(Camera {
        cam_from_world: Pose::look_at(eye, eye - DVec3::Z, east.perp().extend(0.0)),
        focal_px: DVec2::new(ABOVE_M / east.length(), ABOVE_M / south.length()),
        center_px: DVec2::from(size_px.map(|side| 0.5 * f64::from(side))),
        size_px,
    })
}

/// The colour at a position in a rendering, interpolated between pixels; `None` if it shows too little there.
fn look_up(rendering: &Rendering, px: DVec2) -> Option<[u8; 3]> {
    let [width, height] = rendering.size_px.map(|side| side as usize);
    let at = (px - 0.5).clamp(DVec2::ZERO, DVec2::new((width - 1) as f64, (height - 1) as f64));
    let (column, row) = (at.x as usize, at.y as usize);
    let share = (at - at.floor()).as_vec2();
    let mut sum = [0.0; 4];
    for (x, y, weight) in [
        (column, row, (1.0 - share.x) * (1.0 - share.y)),
        (column + 1, row, share.x * (1.0 - share.y)),
        (column, row + 1, (1.0 - share.x) * share.y),
        (column + 1, row + 1, share.x * share.y),
    ] {
        let i = y.min(height - 1) * width + x.min(width - 1);
        (0..3).for_each(|k| sum[k] += weight * rendering.rgb[3 * i + k]);
        sum[3] += weight * rendering.alpha[i];
    }
    // The background is black: without dividing, a thin surface would be dark.
    (sum[3] >= ALPHA_LEAST)
        .then(|| [0, 1, 2].map(|k| (255.0 * sum[k] / sum[3]).round().clamp(0.0, 255.0) as u8))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::lattice::tests::lattice;
    use super::*;

    #[test]
    fn the_camera_shows_each_pixel_where_the_window_has_it() {
        let lattice = lattice([300.0, -400.0], [460.0, -250.0], 0.25);
        let window = Window { at: [512, 0], size: [100, 512] };
        let camera = camera_above(&lattice, window, 5.0).unwrap();
        let columns = lattice.columns(window).unwrap();
        for (x, y) in [(0, 0), (99, 511), (50, 256), (7, 400)] {
            let at = columns[y * 100 + x].at;
            let wanted = DVec2::new(x as f64, y as f64) + 0.5 + f64::from(MARGIN_PX);
            for (z, most_px) in [(5.0, 0.001), (25.0, 0.25)] {
                let px = camera.project(at.extend(z)).unwrap();
                assert!(px.distance(wanted) < most_px, "{px} for {wanted} at z = {z}");
            }
        }
    }

    #[test]
    fn colours_are_interpolated_and_thin_surfaces_are_not_dark() {
        let rendering = Rendering {
            size_px: [2, 1],
            rgb: vec![0.12, 0.2, 0.2, 0.5, 0.5, 0.5],
            alpha: vec![0.2, 1.0],
            depth: Vec::new(),
            normal: Vec::new(),
        };
        let color = |x| look_up(&rendering, DVec2::new(x, 0.5));
        assert_eq!(color(0.5), Some([153, 255, 255]));
        assert_eq!(color(-3.0), Some([153, 255, 255]), "beyond the edge");
        assert!(matches!(color(1.5), Some([127 | 128, ..])));
        assert_eq!(color(1.0), Some([132, 149, 149]));
        let nothing = Rendering { alpha: vec![0.05; 2], ..rendering };
        assert_eq!(look_up(&nothing, DVec2::ONE), None);
    }
}
