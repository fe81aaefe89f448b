//! Finds the same ground in pictures of two models. Patches of one picture are searched in the other by normalised
//! cross-correlation. Each match gives a pair of points in space.

use cosurf_engine::compress::sees_alike;
use cosurf_engine::{Renderer, Rendering};
use cosurf_scene::Camera;
use glam::{DVec2, DVec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Pixels with at most this alpha show no surface.
const ALPHA_MIN: f32 = 0.95;
/// Number of the trusted model's own cameras that must see a point from a direction and distance similar to those of
/// the rendered picture. A single camera does not fix the depth of a point.
const SEERS_MIN: usize = 2;
/// Pixels of a patch on each side of its central pixel.
const PATCH_PX: usize = 5;
/// Side of a square of the picture that gives at most one patch, px.
const CELL_PX: usize = 12;
/// Least mean squared gradient of a patch's grey values along its weaker direction. With a smaller gradient, the patch
/// would look almost the same when it is shifted in this direction.
const GRADIENT2_MIN: f32 = 2e-5;
/// Least correlation of a match, -1..=1.
const CORRELATION_MIN: f32 = 0.7;
/// Least difference between the correlation at the best position and the correlation at any position that is not
/// beside it.
const LEAD_MIN: f32 = 0.05;
/// Positions within this distance of the best position are beside it, px along each axis.
const BESIDE_PX: usize = 2;

/// A model rendered from one camera, with the grey values of the picture.
pub(super) struct Sight {
    camera: Camera,
    rendering: Rendering,
    grey: Vec<f32>,
    width: usize,
    height: usize,
}

/// The result of searching patches of one or more pictures.
#[derive(Clone, Debug, Default)]
pub(super) struct Matches {
    /// Number of patches that were searched.
    pub(super) sought: usize,
    /// The matches that were found.
    pub(super) found: Vec<Pair>,
}

/// A point of the ground, as two models show it.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub(super) struct Pair {
    /// Position of the point in the trusted model, world units.
    pub(super) trusted: DVec3,
    /// Position of the point in the other model, in that model's own frame.
    pub(super) other: DVec3,
    /// Width that one pixel covers at the depth of this point in the trusted model, in that model's units.
    pub(super) trusted_pixel_m: f64,
    /// The same in the other model.
    pub(super) other_pixel_m: f64,
    /// Unit vector from the camera to the point, in the trusted model's frame; zero if the pair has no camera.
    pub(super) trusted_sight: DVec3,
    /// The same in the other model's frame.
    pub(super) other_sight: DVec3,
}

impl Matches {
    pub(super) fn extend(&mut self, more: Self) {
        self.sought += more.sought;
        self.found.extend(more.found);
    }

    /// The same matches with the roles of the two models exchanged.
    pub(super) fn swapped(&self) -> Self {
        Self { sought: self.sought, found: self.found.iter().map(Pair::swapped).collect() }
    }
}

impl Pair {
    fn swapped(&self) -> Self {
        Self {
            trusted: self.other,
            other: self.trusted,
            trusted_pixel_m: self.other_pixel_m,
            other_pixel_m: self.trusted_pixel_m,
            trusted_sight: self.other_sight,
            other_sight: self.trusted_sight,
        }
    }
}

impl Sight {
    pub(super) fn of(renderer: &mut Renderer, camera: Camera) -> Self {
        let rendering = renderer.render(&camera);
        let grey = rendering.rgb.chunks_exact(3).map(|rgb| (rgb[0] + rgb[1] + rgb[2]) / 3.0).collect();
        let [width, height] = camera.size_px.map(|side| side as usize);
        Self { camera, rendering, grey, width, height }
    }

    /// Width and height of the picture, px.
    pub(super) fn size(&self) -> [usize; 2] {
        [self.width, self.height]
    }

    /// Derivatives of the grey values at a pixel that is not on the border, per pixel.
    pub(super) fn gradient(&self, x: usize, y: usize) -> [f32; 2] {
        let i = y * self.width + x;
        [self.grey[i + 1] - self.grey[i - 1], self.grey[i + self.width] - self.grey[i - self.width]]
            .map(|step| 0.5 * step)
    }

    /// True if the pixel shows a surface.
    pub(super) fn is_solid(&self, x: usize, y: usize) -> bool {
        let i = y * self.width + x;
        self.rendering.alpha[i] > ALPHA_MIN && self.rendering.depth[i] > 0.0
    }

    /// The world point on the ray through `at_px`, at the depth of the pixel `(x, y)` that contains `at_px`.
    pub(super) fn point(&self, x: usize, y: usize, at_px: DVec2) -> DVec3 {
        let depth = f64::from(self.rendering.depth[y * self.width + x]);
        self.camera.unproject(at_px, depth)
    }

    /// Unit vector from the camera into the world, through `at_px`.
    fn sight(&self, at_px: DVec2) -> DVec3 {
        let world_from_cam = self.camera.cam_from_world.rotation.inverse();
        (world_from_cam * self.camera.ray(at_px)).normalize()
    }

    /// Width that the pixel `(x, y)` covers at its depth, world units.
    pub(super) fn pixel_m(&self, x: usize, y: usize) -> f64 {
        f64::from(self.rendering.depth[y * self.width + x]) / self.camera.focal_px.x
    }

    fn is_well_seen(&self, x: usize, y: usize, cameras: &[Camera]) -> bool {
        is_well_seen(self.point(x, y, middle(x, y)), &self.camera, cameras)
    }

    /// The distinctive corners in the picture that at least [`SEERS_MIN`] of `cameras` see.
    fn corners(&self, cameras: &[Camera]) -> Vec<[usize; 2]> {
        let cells = |length: usize| (PATCH_PX + 1..length.saturating_sub(PATCH_PX + 1)).step_by(CELL_PX);
        let starts: Vec<[usize; 2]> =
            cells(self.height).flat_map(|y| cells(self.width).map(move |x| [x, y])).collect();
        starts.into_par_iter().filter_map(|start| self.corner(start, cameras)).collect()
    }

    /// The best corner in the square that begins at `start`. `None` if it is too weak, if it shows no surface, or if
    /// too few of `cameras` see it.
    fn corner(&self, start: [usize; 2], cameras: &[Camera]) -> Option<[usize; 2]> {
        let end = |axis: usize, length: usize| (start[axis] + CELL_PX).min(length - PATCH_PX - 1);
        let mut best = (GRADIENT2_MIN, None);
        for y in (start[1]..end(1, self.height)).step_by(2) {
            for x in (start[0]..end(0, self.width)).step_by(2) {
                let strength = self.cornerness(x, y);
                if strength > best.0 {
                    best = (strength, Some([x, y]));
                }
            }
        }
        best.1.filter(|[x, y]| self.is_solid(*x, *y) && self.is_well_seen(*x, *y, cameras))
    }

    /// The smaller eigenvalue of the mean structure tensor of the patch around a pixel (Shi and Tomasi).
    pub(super) fn cornerness(&self, x: usize, y: usize) -> f32 {
        let (mut xx, mut xy, mut yy) = (0.0f32, 0.0f32, 0.0f32);
        for v in y - PATCH_PX..=y + PATCH_PX {
            for u in x - PATCH_PX..=x + PATCH_PX {
                let [dx, dy] = self.gradient(u, v);
                xx += dx * dx;
                xy += dx * dy;
                yy += dy * dy;
            }
        }
        let half = 0.5 * (xx - yy);
        (0.5 * (xx + yy) - libm::hypotf(half, xy)) / AREA
    }

    fn patch(&self, x: usize, y: usize) -> Patch {
        let mut values = [0.0; AREA as usize];
        let rows = (y - PATCH_PX..=y + PATCH_PX)
            .map(|v| &self.grey[v * self.width + x - PATCH_PX..=v * self.width + x + PATCH_PX]);
        values.iter_mut().zip(rows.flatten()).for_each(|(value, grey)| *value = *grey);
        let mean = values.iter().sum::<f32>() / AREA;
        values.iter_mut().for_each(|value| *value -= mean);
        let length = values.iter().map(|value| value * value).sum::<f32>().sqrt();
        Patch { values, length }
    }

    /// Scalar products of a patch with the patches around successive pixels of a row, from `(x, y)` on. The values of the
    /// patch sum up to 0, so the mean of the other patch has no effect.
    ///
    /// The innermost loop is over pixels, so that it works on several at once. A search that cut out each patch and
    /// subtracted its mean took 38 % of the time of the gate; this one takes a tenth of that.
    fn products(&self, patch: &Patch, x: usize, y: usize, products: &mut [f32]) {
        for (v, values) in patch.values.chunks_exact(SIDE).enumerate() {
            let first = (y + v - PATCH_PX) * self.width + x - PATCH_PX;
            for (u, value) in values.iter().enumerate() {
                let grey = &self.grey[first + u..first + u + products.len()];
                products.iter_mut().zip(grey).for_each(|(product, grey)| *product += value * grey);
            }
        }
    }

    /// Searches a patch within `reach_px` of `around`. `contrast` is that of this picture. Returns the best pixel and its
    /// sub-pixel position. `None` if the correlation is low, if no position stands out, or if the best one is on the rim
    /// of the searched area.
    fn find(
        &self,
        contrast: &Contrast,
        patch: &Patch,
        around: [usize; 2],
        reach_px: usize,
    ) -> Option<([usize; 2], DVec2)> {
        let range = |axis: usize, length: usize| {
            around[axis].saturating_sub(reach_px).max(PATCH_PX)
                ..(around[axis] + reach_px + 1).min(length - PATCH_PX)
        };
        let (columns, rows) = (range(0, self.width), range(1, self.height));
        let across = columns.len();
        let mut scores = vec![0.0; across * rows.len()];
        for (row, y) in scores.chunks_exact_mut(across.max(1)).zip(rows.clone()) {
            self.products(patch, columns.start, y, row);
            let lengths = &contrast.0[y * self.width + columns.start..];
            row.iter_mut()
                .zip(lengths)
                .for_each(|(score, length)| *score = correlation(*score, patch.length * length));
        }
        let best = (0..scores.len()).reduce(|a, b| if scores[b] > scores[a] { b } else { a })?;
        let (u, v) = (best % across, best / across);
        let beside =
            |i: usize| (i % across).abs_diff(u) <= BESIDE_PX && (i / across).abs_diff(v) <= BESIDE_PX;
        let second = (0..scores.len()).filter(|i| !beside(*i)).map(|i| scores[i]).fold(-1.0, f32::max);
        if scores[best] < CORRELATION_MIN || scores[best] - second < LEAD_MIN {
            return None;
        }
        // The true position may then lie outside the searched area.
        if u == 0 || v == 0 || u + 1 == across || v + 1 == rows.len() {
            return None;
        }
        let peak = |before: f32, here: f32, after: f32| {
            let bend = before - 2.0 * here + after;
            if bend < 0.0 { f64::from(0.5 * (before - after) / bend).clamp(-0.5, 0.5) } else { 0.0 }
        };
        let beyond = DVec2::new(
            peak(scores[best - 1], scores[best], scores[best + 1]),
            peak(scores[best - across], scores[best], scores[best + across]),
        );
        let [x, y] = [columns.start + u, rows.start + v];
        Some(([x, y], middle(x, y) + beyond))
    }
}

/// Width and height of a patch, px.
const SIDE: usize = 2 * PATCH_PX + 1;
/// Number of pixels of a patch.
const AREA: f32 = (SIDE * SIDE) as f32;

/// The grey values of a patch minus their mean, and the Euclidean norm of these differences.
struct Patch {
    values: [f32; AREA as usize],
    length: f32,
}

/// Normalised cross-correlation of two patches, -1..=1, from their scalar product and the product of their lengths; 0 if
/// either patch is uniform.
fn correlation(product: f32, lengths: f32) -> f32 {
    if lengths > 1e-9 { product / lengths } else { 0.0 }
}

/// For each pixel that is the centre of a patch: the Euclidean norm of the patch's grey values minus their mean.
struct Contrast(Vec<f32>);

impl Contrast {
    fn of(sight: &Sight) -> Self {
        let (width, height) = (sight.width, sight.height);
        let mut lengths = vec![0.0; width * height];
        // Sums over a row of the patch, and then over the rows: of the grey values and of their squares.
        let mut sums = vec![[0.0f64; 2]; width * height];
        for y in 0..height {
            for x in PATCH_PX..width.saturating_sub(PATCH_PX) {
                let row = &sight.grey[y * width + x - PATCH_PX..=y * width + x + PATCH_PX];
                let add = |[sum, squares]: [f64; 2], grey: &f32| {
                    let grey = f64::from(*grey);
                    [sum + grey, squares + grey * grey]
                };
                sums[y * width + x] = row.iter().fold([0.0; 2], add);
            }
        }
        for y in PATCH_PX..height.saturating_sub(PATCH_PX) {
            for x in PATCH_PX..width.saturating_sub(PATCH_PX) {
                let rows = (y - PATCH_PX..=y + PATCH_PX).map(|v| sums[v * width + x]);
                let [sum, squares] = rows.fold([0.0; 2], |a, b| [a[0] + b[0], a[1] + b[1]]);
                let variation = squares - sum * sum / f64::from(AREA);
                lengths[y * width + x] = variation.max(0.0).sqrt() as f32;
            }
        }
        Self(lengths)
    }
}

/// Whether enough of `cameras` see `point` from a direction and distance similar to those of the camera `from`.
pub(super) fn is_well_seen(point: DVec3, from: &Camera, cameras: &[Camera]) -> bool {
    cameras.iter().filter(|camera| sees_alike(from, camera, point)).nth(SEERS_MIN - 1).is_some()
}

/// The middle of a pixel.
pub(super) fn middle(x: usize, y: usize) -> DVec2 {
    DVec2::new(x as f64 + 0.5, y as f64 + 0.5)
}

/// Searches corners of the trusted model's picture in the other model's picture, at most `reach_px` away from the same
/// pixel. Uses only corners that several of the trusted model's own `cameras` see. Both pictures must have the same
/// size.
pub(super) fn matches(trusted: &Sight, cameras: &[Camera], other: &Sight, reach_px: usize) -> Matches {
    let corners = trusted.corners(cameras);
    let contrast = Contrast::of(other);
    let find = |&[x, y]: &[usize; 2]| {
        let ([u, v], at_px) = other.find(&contrast, &trusted.patch(x, y), [x, y], reach_px)?;
        other.is_solid(u, v).then(|| Pair {
            trusted: trusted.point(x, y, middle(x, y)),
            other: other.point(u, v, at_px),
            trusted_pixel_m: trusted.pixel_m(x, y),
            other_pixel_m: other.pixel_m(u, v),
            trusted_sight: trusted.sight(middle(x, y)),
            other_sight: other.sight(at_px),
        })
    };
    Matches { sought: corners.len(), found: corners.par_iter().filter_map(find).collect() }
}
