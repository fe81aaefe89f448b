//! Converts a picture from the layout in tiles to a [`Rendering`], which is stored row by row.

use super::constants::{GRAZING, SURFACE_ALPHA};
use super::planes::{DISTANCE, NORMAL, PLANES_GEOMETRY, RGB, TRANSMITTANCE};
use super::tiles::TileImage;
use super::view::ViewParams;
use crate::backend::Rendering;

/// Converts the blended picture of `view`.
pub(crate) fn rendering(image: &TileImage, view: &ViewParams) -> Rendering {
    let [width, height] = image.size_px();
    let pixels = || (0..height).flat_map(move |y| (0..width).map(move |x| (x, y)));
    let three = |plane: usize| -> Vec<f32> {
        pixels().flat_map(|(x, y)| (0..3).map(move |c| image.value(plane + c, x, y))).collect()
    };
    let alpha: Vec<f32> = pixels().map(|(x, y)| 1.0 - image.value(TRANSMITTANCE, x, y)).collect();
    let (mut normal, mut depth) = (Vec::new(), Vec::new());
    if image.planes() == PLANES_GEOMETRY {
        normal = three(NORMAL);
        depth =
            pixels().zip(&alpha).map(|((x, y), alpha)| unbiased_depth(image, view, x, y, *alpha)).collect();
    }
    Rendering { size_px: view.size_px, rgb: three(RGB), alpha, depth, normal }
}

/// Depth of a pixel along the optical axis, world units: `D / -(N · r)` (PGSR), with the blended plane distance `D`,
/// the blended normal `N` and the ray `r` of the pixel, scaled to z = 1. `D` and `N` are blended with the same weights,
/// so alpha cancels. 0 if alpha is below [`SURFACE_ALPHA`] or the ray grazes the plane ([`GRAZING`]).
fn unbiased_depth(image: &TileImage, view: &ViewParams, x: usize, y: usize, alpha: f32) -> f32 {
    let ray = [
        (x as f32 + 0.5 - view.center_px[0]) / view.focal_px[0],
        (y as f32 + 0.5 - view.center_px[1]) / view.focal_px[1],
        1.0,
    ];
    let facing = -(0..3).map(|axis| image.value(NORMAL + axis, x, y) * ray[axis]).sum::<f32>();
    if alpha < SURFACE_ALPHA || facing < GRAZING * alpha {
        return 0.0;
    }
    image.value(DISTANCE, x, y) / facing
}
