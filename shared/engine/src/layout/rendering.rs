//! Converts a picture from the layout in tiles to a [`Rendering`], which is stored row by row.

use rayon::prelude::*;

use super::constants::{GRAZING, SURFACE_ALPHA};
use super::planes::{DISTANCE, NORMAL, PLANES_GEOMETRY, RGB, TRANSMITTANCE};
use super::tiles::{TILE, TileImage};
use super::view::ViewParams;
use crate::backend::Rendering;

/// Smallest number of lines that a thread converts.
const LINES_AT_ONCE: usize = 16;

/// Converts the blended picture of `view`, line by line, on all threads of the pool that calls it. With an iterator over single
/// pixels, the conversion took a seventh of the time that the aggregator needs to compare models.
pub(crate) fn rendering(image: &TileImage, view: &ViewParams) -> Rendering {
    let [width, height] = image.size_px();
    let pixels = width * height;
    let (mut rgb, mut alpha) = (vec![0.0; 3 * pixels], vec![0.0; pixels]);
    let lines = rgb.par_chunks_exact_mut(3 * width).zip(alpha.par_chunks_exact_mut(width)).enumerate();
    lines.with_min_len(LINES_AT_ONCE).for_each(|(y, (rgb, alpha))| {
        let planes = [RGB, RGB + 1, RGB + 2, TRANSMITTANCE];
        each_pixel(image, y, planes, |x, [red, green, blue, transmittance]| {
            rgb[3 * x..3 * x + 3].copy_from_slice(&[red, green, blue]);
            alpha[x] = 1.0 - transmittance;
        });
    });
    let pixels = if image.planes() == PLANES_GEOMETRY { pixels } else { 0 };
    let (mut depth, mut normal) = (vec![0.0; pixels], vec![0.0; 3 * pixels]);
    let lines = depth.par_chunks_exact_mut(width).zip(normal.par_chunks_exact_mut(3 * width)).enumerate();
    lines.with_min_len(LINES_AT_ONCE).for_each(|(y, (depth, normal))| {
        let planes = [NORMAL, NORMAL + 1, NORMAL + 2, DISTANCE, TRANSMITTANCE];
        each_pixel(image, y, planes, |x, [nx, ny, nz, distance, transmittance]| {
            normal[3 * x..3 * x + 3].copy_from_slice(&[nx, ny, nz]);
            depth[x] = unbiased_depth(view, [x, y], [nx, ny, nz], distance, transmittance);
        });
    });
    Rendering { size_px: view.size_px, rgb, alpha, depth, normal }
}

/// Visits the pixels of picture row `y` with their values in some planes.
fn each_pixel<const N: usize>(
    image: &TileImage,
    y: usize,
    planes: [usize; N],
    mut visit: impl FnMut(usize, [f32; N]),
) {
    let width = image.size_px()[0];
    for tile_x in 0..image.tiles()[0] {
        let rows = planes.map(|plane| *image.row(plane, y, tile_x));
        for x in 0..TILE.min(width - TILE * tile_x) {
            visit(TILE * tile_x + x, rows.each_ref().map(|row| row.0[x]));
        }
    }
}

/// Depth of the pixel `[x, y]` along the optical axis, world units: `D / -(N · r)` (PGSR), with the blended plane
/// distance `D`, the blended normal `N` and the ray `r` of the pixel, scaled to z = 1. `D` and `N` are blended with the
/// same weights, so alpha cancels. 0 if alpha is below [`SURFACE_ALPHA`] or the ray grazes the plane ([`GRAZING`]).
fn unbiased_depth(
    view: &ViewParams,
    [x, y]: [usize; 2],
    normal: [f32; 3],
    distance: f32,
    transmittance: f32,
) -> f32 {
    let alpha = 1.0 - transmittance;
    let ray = [
        (x as f32 + 0.5 - view.center_px[0]) / view.focal_px[0],
        (y as f32 + 0.5 - view.center_px[1]) / view.focal_px[1],
        1.0,
    ];
    let facing = -(0..3).map(|axis| normal[axis] * ray[axis]).sum::<f32>();
    if alpha < SURFACE_ALPHA || facing < GRAZING * alpha {
        return 0.0;
    }
    distance / facing
}
