//! Reading results out of the backend's own layouts.

use cosurf_scene::Splats;
use cosurf_scene::splats::sh_coefficients;

use super::blocks::{Blocks, LOG_SCALE, MEAN, OPACITY, QUAT};
use super::image::TileImage;
use super::project::view_direction;
use super::project_backward::{GRADIENT_RGB, STAT_ABSOLUTE_GRADIENT, STAT_SCREEN_GRADIENT, STAT_VIEWS};
use super::rasterize::{DISTANCE, NORMAL, PLANES_GEOMETRY, RGB, TRANSMITTANCE};
use super::score::{HITS, OBSERVED, SQUARED_WEIGHT};
use super::sh;
use super::simd::{GROUP, Lanes, Plain};
use super::surface::{GRAZING, SURFACE_ALPHA};
use super::view::ViewParams;
use crate::backend::{Rendering, Scores, Shapes};

/// The picture, row by row.
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

/// `D / -(N · r)` (PGSR), where both are blended with the same weights, so alpha cancels.
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

/// Shapes and mean statistics of all splats.
pub(super) fn shapes(params: &Blocks, stats: &Blocks) -> Shapes {
    let n = params.len();
    let views: Vec<f32> = (0..n).map(|i| stats.value(i, STAT_VIEWS)).collect();
    let mean = |row: usize| (0..n).map(|i| stats.value(i, row) / views[i].max(1.0)).collect();
    Shapes {
        means: (0..n).map(|i| [0, 1, 2].map(|k| params.value(i, MEAN + k))).collect(),
        quats: (0..n).map(|i| [0, 1, 2, 3].map(|k| params.value(i, QUAT + k))).collect(),
        log_scales: (0..n).map(|i| [0, 1, 2].map(|k| params.value(i, LOG_SCALE + k))).collect(),
        opacity_logits: (0..n).map(|i| params.value(i, OPACITY)).collect(),
        screen_gradients: mean(STAT_SCREEN_GRADIENT),
        absolute_gradients: mean(STAT_ABSOLUTE_GRADIENT),
        views,
    }
}

/// Scores as they are.
pub(super) fn scores(scores: &Blocks) -> Scores {
    let row = |row: usize| (0..scores.len()).map(|i| scores.value(i, row)).collect();
    Scores { squared_weights: row(SQUARED_WEIGHT), hits: row(HITS), observers: row(OBSERVED) }
}

/// Gradients in the places of their parameters; zero for splats that were not seen.
pub(super) fn gradients(
    params: &Blocks,
    gradients: &Blocks,
    visible: &[u16],
    view: &ViewParams,
    sh_degree: u32,
) -> Splats {
    let mut out = Splats::with_capacity(params.len(), sh_degree);
    for i in 0..params.len() {
        let seen = visible[i / GROUP] >> (i % GROUP) & 1 == 1;
        let get = |row: usize| if seen { gradients.value(i, row) } else { 0.0 };
        let mean = [0, 1, 2].map(|a| params.value(i, MEAN + a));
        let sh = sh_gradients(mean, [0, 1, 2].map(|k| get(GRADIENT_RGB + k)), view, sh_degree);
        out.push(
            [0, 1, 2].map(|k| get(MEAN + k)),
            [0, 1, 2, 3].map(|k| get(QUAT + k)),
            [0, 1, 2].map(|k| get(LOG_SCALE + k)),
            get(OPACITY),
            &sh,
        );
    }
    out
}

/// Gradients of a splat's coefficients: the basis, as the view sees the splat, times ∂L/∂rgb.
pub(crate) fn sh_gradients(mean: [f32; 3], v_rgb: [f32; 3], view: &ViewParams, sh_degree: u32) -> Vec<f32> {
    let (dir, _) = view_direction(mean.map(Plain::splat), view);
    let basis = sh::basis(dir, view.sh_degree);
    let mut sh = vec![0.0; 3 * sh_coefficients(sh_degree)];
    for (k, value) in sh.iter_mut().enumerate().take(3 * sh_coefficients(view.sh_degree)) {
        let mut y = [0.0; GROUP];
        basis[k / 3].store(&mut y);
        *value = y[0] * v_rgb[k % 3];
    }
    sh
}
