//! The terrain: the heights of the bare ground, without buildings, plants and vehicles.
//!
//! Cells of a metre are ground or not by the progressive morphological filter (Zhang et al. 2003), which sees the lowest
//! height of each. A pixel of a ground cell keeps its height of the surface if that is about the height of the cells around
//! it. All other pixels get a height between those of the ground around.
//!
//! Where it errs: ridges steeper than twice [`filter::SLOPE`] lose their tops, objects wider than twice
//! [`filter::HALF_WIDTH_MAX_M`] and objects lower than [`filter::STEP_LEAST_M`] are taken for ground.
//!
//! What it knows nothing about: files and meshes.
//!
//! Where to start reading: [`find_terrain`], then [`filter`] and [`fill`].

mod fill;
mod filter;
mod reach;

use cosurf_scene::SceneError;
use glam::DVec2;

use super::grid::Grid;
use super::tiles::Tiles;
use fill::fill;
use filter::{HALF_WIDTH_MAX_M, STEP_LEAST_M, is_ground};
use reach::Reach;

/// Side of the cells, metres: small enough for a yard, large enough that the mean of a cell has little noise.
const CELL_M: f64 = 1.0;

/// Finds the height of the terrain at each pixel that has a height of the surface.
pub(super) fn find_terrain(
    surface: &mut Tiles<f32>,
    gsd_m: f64,
    terrain: &mut Tiles<f32>,
    memory_bytes: u64,
) -> Result<(), SceneError> {
    let ground = Ground::of(surface, gsd_m, memory_bytes)?;
    for tile in 0..surface.len() {
        let (window, mut heights) = (surface.window(tile), surface.read(tile)?);
        for (i, height) in heights.iter_mut().enumerate().filter(|(_, height)| !height.is_nan()) {
            *height = ground.height(window.middle_of(i), *height);
        }
        terrain.write(tile, &heights)?;
    }
    Ok(())
}

/// Leaves the terrain only where the surface can be trusted, and between such places: below an object of any width that the
/// filter knows. Returns the lowest and the highest height that is left; `surface` has no others than trusted heights.
pub(super) fn leave_trusted(
    terrain: &mut Tiles<f32>,
    surface: &mut Tiles<f32>,
    gsd_m: f64,
    memory_bytes: u64,
) -> Result<[f64; 2], SceneError> {
    let cell_px = (CELL_M / gsd_m).round().max(1.0) as u32;
    let grid = Grid::of(surface, cell_px, memory_bytes)?;
    let cell_m = f64::from(grid.cell_px) * gsd_m;
    let reach = Reach::of(&grid.heights, grid.size, (2.0 * HALF_WIDTH_MAX_M / cell_m) as usize);
    let mut range_m = [f64::INFINITY, f64::NEG_INFINITY];
    for tile in 0..terrain.len() {
        let (window, trusted) = (terrain.window(tile), surface.read(tile)?);
        let mut heights = terrain.read(tile)?;
        for (i, height) in heights.iter_mut().enumerate().filter(|(_, height)| !height.is_nan()) {
            let [column, row] = (window.middle_of(i) / f64::from(grid.cell_px)).to_array();
            if trusted[i].is_nan() && !reach.has([column as usize, row as usize]) {
                *height = f32::NAN;
                continue;
            }
            range_m = [range_m[0].min(f64::from(*height)), range_m[1].max(f64::from(*height))];
        }
        terrain.write(tile, &heights)?;
    }
    Ok(range_m)
}

/// The ground, cell by cell.
struct Ground {
    /// With a height in every cell.
    grid: Grid,
    /// For each cell: whether its height was measured, and not taken from around.
    is_measured: Vec<bool>,
}

impl Ground {
    fn of(surface: &mut Tiles<f32>, gsd_m: f64, memory_bytes: u64) -> Result<Self, SceneError> {
        let cell_px = (CELL_M / gsd_m).round().max(1.0) as u32;
        let mut grid = Grid::lowest(surface, cell_px, memory_bytes)?;
        let is_measured = is_ground(&grid.heights, grid.size, f64::from(grid.cell_px) * gsd_m);
        let lowest = std::mem::take(&mut grid.heights);
        grid.heights = vec![f32::NAN; lowest.len()];
        grid.average(surface, |cell, height| {
            is_measured[cell] && f64::from(height - lowest[cell]) <= STEP_LEAST_M
        })?;
        fill(&mut grid.heights, grid.size);
        Ok(Self { grid, is_measured })
    }

    /// Height of the terrain at a place where the surface has this height, metres.
    fn height(&self, px: DVec2, surface_m: f32) -> f32 {
        let [width, height] = self.grid.size;
        let most = DVec2::new((width - 1) as f64, (height - 1) as f64);
        let at = self.grid.cell(px).clamp(DVec2::ZERO, most);
        let (share, [x, y]) = (at.fract().as_vec2(), [at.x as usize, at.y as usize]);
        let next = [(x + 1).min(width - 1), (y + 1).min(height - 1)];
        let row = |y: usize| {
            let [a, b] = [x, next[0]].map(|x| self.grid.heights[y * width + x]);
            a + (b - a) * share.x
        };
        let (north, south) = (row(y), row(next[1]));
        let smooth = north + (south - north) * share.y;
        let nearest = (at.y.round() as usize) * width + at.x.round() as usize;
        let is_near = f64::from((surface_m - smooth).abs()) <= STEP_LEAST_M;
        // Without any ground, as on a map of one roof, the surface is all that is known.
        if (self.is_measured[nearest] && is_near) || smooth.is_nan() { surface_m } else { smooth }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_city::{City, CitySettings};
    use cosurf_scene::Caster;

    use super::*;

    const SIDE_PX: u32 = 500;
    const GSD_M: f64 = 0.2;
    const MEMORY_BYTES: u64 = 1 << 30;

    /// The terrain of a map of 100 m × 100 m, in tiles of this side, and the surface, row by row.
    fn terrain(height: impl Fn(DVec2) -> f32, tile_px: u32) -> Vec<[f32; 2]> {
        let folder = tempfile::tempdir().unwrap();
        let [mut surface, mut terrain] =
            [(); 2].map(|()| Tiles::new(folder.path(), [SIDE_PX; 2], tile_px).unwrap());
        for tile in 0..surface.len() {
            let window = surface.window(tile);
            let at = |i: u32| {
                let [x, y] = [window.at[0] + i % window.size[0], window.at[1] + i / window.size[0]];
                DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5) * GSD_M - 50.0
            };
            let values: Vec<f32> = (0..window.pixels() as u32).map(|i| height(at(i))).collect();
            surface.write(tile, &values).unwrap();
        }
        find_terrain(&mut surface, GSD_M, &mut terrain, MEMORY_BYTES).unwrap();
        let mut all = vec![[0.0; 2]; (SIDE_PX * SIDE_PX) as usize];
        for tile in 0..surface.len() {
            let window = surface.window(tile);
            let values = terrain.read(tile).unwrap().into_iter().zip(surface.read(tile).unwrap());
            for (i, (terrain, surface)) in values.enumerate() {
                let [x, y] = [i as u32 % window.size[0], i as u32 / window.size[0]];
                all[((window.at[1] + y) * SIDE_PX + window.at[0] + x) as usize] = [terrain, surface];
            }
        }
        all
    }

    #[test]
    fn the_terrain_of_the_city_has_no_buildings_and_trees() {
        let city = City::build(&CitySettings { extent_m: 120.0, ..CitySettings::default() }).unwrap();
        let [ground, all] = [city.ground_mesh(), city.truth_mesh()].map(|mesh| Caster::new(&mesh));
        let from_top = |caster: &Caster, at: DVec2| caster.height_below(at.extend(200.0));
        let found = terrain(|at| from_top(&all, at).map_or(f32::NAN, |height| height as f32), 512);
        let (mut errors, mut objects) = (Vec::new(), 0);
        for (i, [terrain, surface]) in found.iter().enumerate().filter(|(_, [terrain, _])| !terrain.is_nan())
        {
            let [x, y] =
                [i as u32 % SIDE_PX, i as u32 / SIDE_PX].map(|of| (f64::from(of) + 0.5) * GSD_M - 50.0);
            let Some(truth) = from_top(&ground, DVec2::new(x, y)) else { continue };
            errors.push(f64::from(*terrain) - truth);
            objects += usize::from(f64::from(*surface) - truth > 2.0);
        }
        errors.sort_by(|a, b| a.abs().total_cmp(&b.abs()));
        let rmse = (errors.iter().map(|error| error * error).sum::<f64>() / errors.len() as f64).sqrt();
        let most_95 = errors[errors.len() * 95 / 100].abs();
        let share = objects as f64 / errors.len() as f64;
        println!(
            "{} px, {share:.2} below objects: RMSE {rmse:.3} m, 95 % within {most_95:.3} m",
            errors.len()
        );
        assert!(errors.len() > 200_000 && share > 0.2, "{} px, {share} below objects", errors.len());
        assert!(rmse < 0.15 && most_95 < 0.2, "RMSE {rmse} m, 95 % within {most_95} m");
    }

    /// Of a square of trusted heights with a hole, the terrain keeps the hole, and nothing beyond the square.
    #[test]
    fn the_terrain_ends_where_no_height_can_be_trusted() {
        let folder = tempfile::tempdir().unwrap();
        let [mut surface, mut terrain] =
            [(); 2].map(|()| Tiles::new(folder.path(), [SIDE_PX; 2], 128).unwrap());
        let is_in = |at: DVec2, half_px: f64| (at - 250.0).abs().max_element() < half_px;
        for tile in 0..surface.len() {
            let window = surface.window(tile);
            let trusted = |i: usize| match window.middle_of(i) {
                at if is_in(at, 30.0) || !is_in(at, 150.0) => f32::NAN,
                _ => 70.0,
            };
            surface.write(tile, &(0..window.pixels()).map(trusted).collect::<Vec<f32>>()).unwrap();
            let slope = |i: usize| 70.0 + 0.01 * window.middle_of(i).x as f32;
            terrain.write(tile, &(0..window.pixels()).map(slope).collect::<Vec<f32>>()).unwrap();
        }
        let range_m = leave_trusted(&mut terrain, &mut surface, GSD_M, MEMORY_BYTES).unwrap();
        assert!((range_m[0] - 71.0).abs() < 0.02 && (range_m[1] - 74.0).abs() < 0.02, "{range_m:?}");
        for tile in 0..terrain.len() {
            let window = terrain.window(tile);
            for (i, height) in terrain.read(tile).unwrap().iter().enumerate() {
                assert_eq!(height.is_nan(), !is_in(window.middle_of(i), 150.0), "{}", window.middle_of(i));
            }
        }
    }

    #[test]
    fn slopes_stay_as_they_are_whatever_the_tiles_are() {
        let slope = |at: DVec2| (60.0 + 0.1 * at.x + 0.05 * at.y) as f32;
        let house = |at: DVec2| (at - DVec2::new(7.0, -9.0)).abs().cmplt(DVec2::new(6.0, 11.0)).all();
        let surface = |at: DVec2| match at {
            _ if house(at) => slope(at) + 6.0,
            _ if at.length() > 48.0 => f32::NAN,
            _ => slope(at),
        };
        let found = terrain(surface, 512);
        for (i, [terrain, surface]) in found.iter().enumerate() {
            let [x, y] =
                [i as u32 % SIDE_PX, i as u32 / SIDE_PX].map(|of| (f64::from(of) + 0.5) * GSD_M - 50.0);
            let at = DVec2::new(x, y);
            assert_eq!(terrain.is_nan(), surface.is_nan());
            let error = terrain - slope(at);
            assert!(terrain.is_nan() || error.abs() < 0.3, "{at}: {terrain}, {error} too high");
        }
        let bits =
            |found: &[[f32; 2]]| found.iter().map(|[terrain, _]| terrain.to_bits()).collect::<Vec<_>>();
        assert!(bits(&found) == bits(&terrain(surface, 96)), "the tiles' size must not matter");
    }
}
