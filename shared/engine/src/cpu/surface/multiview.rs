//! The multi-view losses on sampled pixels (PGSR): the reprojection error by way of a neighbouring view, and the
//! similarity of patches under the homography of the blended plane.
//!
//! *Reprojection.* The point that a pixel shows is projected into the neighbouring view. The neighbouring view has a
//! depth at this position, which gives another point. That point is projected back, and `e` is its distance from the
//! pixel, px. If `e < 1`, the loss is `w e` with `w = exp(-e)` held constant; otherwise it is 0. The depth of the
//! neighbouring view is held constant too: each view is in turn the neighbour of others, so gradients through this
//! depth would be redundant.
//!
//! *NCC*, the normalised cross-correlation. The blended plane is `-(N · X) = D`. The transform `neighbour_from_here`
//! between the camera frames has the rotation `R` and the translation `t`. In the frame of the neighbouring view, a
//! point `X` of the plane is `R X - t (N · X) / D`. For a point on the ray `r`, this is proportional to `R r + s t`,
//! where `s = -(m · r)` with `m = N / D` is the inverse depth of the plane. So the warp of a patch depends on the plane
//! only through `s`.
//!
//! The loss of a patch is `w (1 - NCC²)`, with the weight `w` of the reprojection error of its pixel. `NCC²` is
//! `cov² / (var₁ var₂ + ε)`, with the covariance and the variances of both patches and a small `ε`. A patch counts if
//! the covariance is positive and `1 - NCC² < 0.9`. PGSR does not check the covariance, so in PGSR a patch matches its
//! negative too.

use rayon::prelude::*;

use super::depth::ray_y;
use super::plane::Plane;
use super::shown::{Shown, band_row, bands};
use crate::backend::{MultiviewWeights, PatchSide, SurfaceLoss};
use crate::layout::constants::{
    DISAGREEMENT_MAX, MASKED_LUMA, NEAR, PATCH_MAX, RETURN_MAX_PX, VARIANCES_MIN,
};
use crate::layout::planes::{DISTANCE, NORMAL};
use crate::layout::sampling::sampled_pixel;
use crate::layout::tiles::{TILE, TileImage};
use crate::layout::view::{RelativePose, ViewParams};
use crate::simd::{Isa, Kernel, Lanes, Row, each};

/// A view and its neighbouring view. Intrinsics, depth and luma are those of the neighbouring view.
pub(super) struct Pair<'a> {
    pose: RelativePose,
    focal_px: [f32; 2],
    center_px: [f32; 2],
    depth: &'a Plane,
    luma: &'a Plane,
}

#[inline(always)]
fn dot<L: Lanes>(a: [f32; 3], b: [f32; 3]) -> f32 {
    L::fused(a[0], b[0], L::fused(a[1], b[1], a[2] * b[2]))
}

impl<'a> Pair<'a> {
    pub(super) fn new(here: &ViewParams, there: &ViewParams, depth: &'a Plane, luma: &'a Plane) -> Self {
        let pose = RelativePose::new(here, there);
        Self { pose, focal_px: there.focal_px, center_px: there.center_px, depth, luma }
    }

    #[inline(always)]
    fn rotate<L: Lanes>(&self, v: [f32; 3]) -> [f32; 3] {
        let rows = &self.pose.rotation;
        [dot::<L>(rows[0], v), dot::<L>(rows[1], v), dot::<L>(rows[2], v)]
    }

    #[inline(always)]
    fn rotate_back(&self, v: [f32; 3]) -> [f32; 3] {
        std::array::from_fn(|c| (0..3).map(|r| self.pose.rotation[r][c] * v[r]).sum())
    }
}

/// A point on the screen, and its derivative with respect to a depth or an inverse depth.
struct Moving {
    at_px: [f32; 2],
    by_px: [f32; 2],
}

/// Projects `point`, whose derivative with respect to a depth is `by`. `None` if the point is behind the camera or too
/// close to it.
#[inline(always)]
fn project<L: Lanes>(
    point: [f32; 3],
    by: [f32; 3],
    focal_px: [f32; 2],
    center_px: [f32; 2],
) -> Option<Moving> {
    if point[2] <= NEAR {
        return None;
    }
    let inv_z = 1.0 / point[2];
    let slope = [point[0] * inv_z, point[1] * inv_z];
    Some(Moving {
        at_px: each!([0, 1], |a| L::fused(focal_px[a], slope[a], center_px[a])),
        by_px: [0, 1].map(|a| focal_px[a] * (by[a] - slope[a] * by[2]) * inv_z),
    })
}

/// A sampled pixel, with its ray, blended plane and depth.
struct Sampled {
    x: usize,
    y: usize,
    ray: [f32; 3],
    normal: [f32; 3],
    distance: f32,
    depth: f32,
}

/// Gradients with respect to the blended plane of a pixel.
#[derive(Default)]
struct PlaneGradient {
    normal: [f32; 3],
    distance: f32,
}

/// The losses with their scratch memory.
#[derive(Debug)]
pub(super) struct Multiview {
    /// Sums of each band.
    sums: Vec<Sums>,
}

impl Multiview {
    /// Memory for pictures up to `size_px`.
    pub(super) fn with_capacity(size_px: [u32; 2]) -> Self {
        Self { sums: Vec::with_capacity(TileImage::tiles_of(size_px)[1]) }
    }

    /// Writes both losses and the shares of sampled pixels that count to `loss`, and adds their weighted gradients to
    /// `gradient`.
    pub(super) fn loss(
        &mut self,
        isa: Isa,
        scene: &Shown,
        pair: &Pair,
        weights: &MultiviewWeights,
        gradient: &mut TileImage,
        loss: &mut SurfaceLoss,
    ) {
        let [width, height] = scene.image.size_px();
        let cell = weights.cell_px as usize;
        assert!(cell.is_power_of_two() && cell <= TILE, "a cell of {cell} px");
        let samples = (width.div_ceil(cell) * height.div_ceil(cell)) as f64;
        let each = Weights {
            reprojection: weights.reprojection / samples as f32,
            ncc: weights.ncc / samples as f32,
            cell,
            patch: weights.patch,
            draw: weights.draw,
        };
        self.sums.resize(scene.image.tiles()[1], Sums::default());
        let weights = &each;
        bands(scene.image, gradient).zip(self.sums.par_iter_mut()).for_each(|((band, gradient), sums)| {
            *sums = isa.run(MultiviewBand { scene, pair, weights, band, gradient });
        });
        let total = self.sums.iter().copied().fold(Sums::default(), Sums::plus);
        loss.reprojection = total.reprojection / samples;
        loss.ncc = total.ncc / samples;
        loss.returned = total.returned as f64 / samples;
        loss.matched = total.matched as f64 / samples;
    }
}

/// Weights of one sample, and how pixels are sampled.
struct Weights {
    reprojection: f32,
    ncc: f32,
    cell: usize,
    patch: PatchSide,
    draw: u64,
}

#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    reprojection: f64,
    ncc: f64,
    returned: usize,
    matched: usize,
}

impl Sums {
    fn plus(self, other: Self) -> Self {
        Self {
            reprojection: self.reprojection + other.reprojection,
            ncc: self.ncc + other.ncc,
            returned: self.returned + other.returned,
            matched: self.matched + other.matched,
        }
    }
}

/// Computes the losses of a band, pixel by pixel. It needs no vectors; it is a kernel because [`Lanes::fused`] is then one
/// instruction.
struct MultiviewBand<'a> {
    scene: &'a Shown<'a>,
    pair: &'a Pair<'a>,
    weights: &'a Weights,
    band: usize,
    gradient: &'a mut [Row],
}

impl Kernel for MultiviewBand<'_> {
    type Output = Sums;

    #[inline(always)]
    fn run<L: Lanes>(self) -> Sums {
        match self.weights.patch {
            PatchSide::Px3 => self.run_with::<L, 3, 9>(),
            PatchSide::Px7 => self.run_with::<L, 7, PATCH_MAX>(),
        }
    }
}

impl MultiviewBand<'_> {
    /// With patches of `SIDE` px, which have `PATCH` pixels.
    #[inline(always)]
    fn run_with<L: Lanes, const SIDE: usize, const PATCH: usize>(self) -> Sums {
        let Self { scene, pair, weights, band, gradient } = self;
        let mut sums = Sums::default();
        let [width, _] = scene.image.size_px();
        for top in scene.rows(band).step_by(weights.cell) {
            for left in (0..width).step_by(weights.cell) {
                let Some(sampled) = sample(scene, weights, left, top) else { continue };
                let error = reprojection_error::<L>(scene.view, pair, &sampled);
                let Some((e, by_depth)) = error else { continue };
                let trust = libm::expf(-e);
                sums.returned += 1;
                sums.reprojection += f64::from(trust * e);
                let mut given = through_depth(&sampled, weights.reprojection * trust * by_depth);
                if let Some((disagreement, by_plane)) = patches::<L, SIDE, PATCH>(scene, pair, &sampled) {
                    sums.matched += 1;
                    sums.ncc += f64::from(trust * disagreement);
                    let by_plane = each!([0, 1, 2], |k| by_plane[k] * weights.ncc * trust);
                    through_ratio::<L>(&sampled, by_plane, &mut given);
                }
                add(scene.image, &sampled, &given, gradient);
            }
        }
        sums
    }
}

/// The sampled pixel of a cell, if it lies in the picture, is not masked and shows a surface.
fn sample(scene: &Shown, weights: &Weights, left: usize, top: usize) -> Option<Sampled> {
    let [x, y] = sampled_pixel(weights.cell, weights.draw, left, top);
    let [width, height] = scene.image.size_px();
    if x >= width || y >= height {
        return None;
    }
    let depth = scene.depth.value(x, y);
    if depth <= 0.0 || scene.luma.value(x, y) <= MASKED_LUMA {
        return None;
    }
    let get = |plane: usize| scene.image.value(plane, x, y);
    Some(Sampled {
        x,
        y,
        ray: ray(scene.view, x as f32, y as f32),
        normal: [get(NORMAL), get(NORMAL + 1), get(NORMAL + 2)],
        distance: get(DISTANCE),
        depth,
    })
}

/// The ray of a pixel, scaled to z = 1.
fn ray(view: &ViewParams, x: f32, y: f32) -> [f32; 3] {
    [(x + 0.5 - view.center_px[0]) / view.focal_px[0], ray_y(view, y), 1.0]
}

/// The reprojection error of a pixel, px, and its derivative with respect to the pixel's depth. `None` if the
/// neighbouring view has no depth or is masked at the projected position, a point is behind a camera, or the error is
/// [`RETURN_MAX_PX`] or more.
#[inline(always)]
fn reprojection_error<L: Lanes>(here: &ViewParams, pair: &Pair, sampled: &Sampled) -> Option<(f32, f32)> {
    let by = pair.rotate::<L>(sampled.ray);
    let there = each!([0, 1, 2], |k| L::fused(sampled.depth, by[k], pair.pose.translation[k]));
    let q = project::<L>(there, by, pair.focal_px, pair.center_px)?;
    let depth = pair.depth.sample::<L>(q.at_px)?;
    if depth.least <= 0.0 || pair.luma.sample::<L>(q.at_px)?.least <= MASKED_LUMA {
        return None;
    }
    let by_depth = depth.slope[0] * q.by_px[0] + depth.slope[1] * q.by_px[1];
    let slope: [f32; 2] = std::array::from_fn(|a| (q.at_px[a] - pair.center_px[a]) / pair.focal_px[a]);
    let hit = [depth.value * slope[0], depth.value * slope[1], depth.value];
    let along = each!([0, 1], |a| L::fused(by_depth, slope[a], depth.value * q.by_px[a] / pair.focal_px[a]));
    let hit_by = [along[0], along[1], by_depth];
    let back = pair.rotate_back(std::array::from_fn(|k| hit[k] - pair.pose.translation[k]));
    let p = project::<L>(back, pair.rotate_back(hit_by), here.focal_px, here.center_px)?;
    let off = [p.at_px[0] - (sampled.x as f32 + 0.5), p.at_px[1] - (sampled.y as f32 + 0.5)];
    let e = (off[0] * off[0] + off[1] * off[1]).sqrt();
    let slope = (off[0] * p.by_px[0] + off[1] * p.by_px[1]) / e.max(1e-6);
    // A comparison with NaN is false, so an error of NaN gives `None`.
    (e < RETURN_MAX_PX).then_some((e, slope))
}

/// Gradients with respect to the plane, given ∂L/∂z, through `z = D / f` with `f = -(N · r)`.
fn through_depth(sampled: &Sampled, v_depth: f32) -> PlaneGradient {
    let facing = sampled.distance / sampled.depth;
    let distance = v_depth / facing;
    PlaneGradient { distance, normal: sampled.ray.map(|r| distance * sampled.depth * r) }
}

/// Adds the gradients with respect to the plane, given ∂L/∂m, through `m = N / D`.
#[inline(always)]
fn through_ratio<L: Lanes>(sampled: &Sampled, v_ratio: [f32; 3], into: &mut PlaneGradient) {
    let inv_distance = 1.0 / sampled.distance;
    for axis in 0..3 {
        into.normal[axis] += v_ratio[axis] * inv_distance;
    }
    into.distance -= dot::<L>(v_ratio, sampled.normal) * inv_distance * inv_distance;
}

/// `1 - NCC²` of the patch around a pixel and its warp in the neighbouring view, and the derivative with respect to
/// `m = N / D`. `None` if a patch leaves its picture or is masked in part, the plane is behind a camera, or the patches do
/// not match.
#[inline(always)]
fn patches<L: Lanes, const SIDE: usize, const PATCH: usize>(
    scene: &Shown,
    pair: &Pair,
    sampled: &Sampled,
) -> Option<(f32, [f32; 3])> {
    let [width, height] = scene.image.size_px();
    let (x, y) = (sampled.x, sampled.y);
    let reach = SIDE / 2;
    if x < reach || y < reach || x + reach >= width || y + reach >= height {
        return None;
    }
    let inv_distance = 1.0 / sampled.distance;
    let ratio = sampled.normal.map(|n| n * inv_distance);
    let (mut here, mut there) = ([0.0f32; PATCH], [0.0f32; PATCH]);
    // For each pixel of the patch: derivative of luma in the neighbouring view with respect to the inverse depth of the
    // plane.
    let mut slopes = [0.0f32; PATCH];
    for i in 0..PATCH {
        let (px, py) = (x + i % SIDE - reach, y + i / SIDE - reach);
        let r = ray(scene.view, px as f32, py as f32);
        let inverse_depth = -dot::<L>(ratio, r);
        // The plane is behind the camera of this view.
        if inverse_depth <= 0.0 {
            return None;
        }
        let turned = pair.rotate::<L>(r);
        let point = each!([0, 1, 2], |k| L::fused(inverse_depth, pair.pose.translation[k], turned[k]));
        // The plane is behind the camera of the neighbouring view, or too close to it. `point` is the point of the
        // plane times its inverse depth, so NEAR is scaled as well.
        if point[2] <= NEAR * inverse_depth {
            return None;
        }
        let q = warp::<L>(point, pair);
        let sample = pair.luma.sample::<L>(q.at_px)?;
        here[i] = scene.luma.value(px, py);
        if here[i].min(sample.least) <= MASKED_LUMA {
            return None;
        }
        there[i] = sample.value;
        slopes[i] = sample.slope[0] * q.by_px[0] + sample.slope[1] * q.by_px[1];
    }
    let correlation = Correlation::of::<L, PATCH>(&here, &there);
    let disagreement = correlation.disagreement();
    if correlation.covariance <= 0.0 || disagreement >= DISAGREEMENT_MAX {
        return None;
    }
    let v_there = correlation.by_second(&here, &there);
    let mut by_plane = [0.0; 3];
    for i in 0..PATCH {
        let r = ray(scene.view, (x + i % SIDE) as f32 - reach as f32, (y + i / SIDE) as f32 - reach as f32);
        let v = v_there[i] * slopes[i];
        by_plane = std::array::from_fn(|k| by_plane[k] - v * r[k]);
    }
    Some((disagreement, by_plane))
}

/// Projects `point` into the neighbouring view, and computes the derivative with respect to the inverse depth of the
/// plane.
#[inline(always)]
fn warp<L: Lanes>(point: [f32; 3], pair: &Pair) -> Moving {
    let inv_z = 1.0 / point[2];
    let slope = [point[0] * inv_z, point[1] * inv_z];
    let t = pair.pose.translation;
    Moving {
        at_px: each!([0, 1], |a| L::fused(pair.focal_px[a], slope[a], pair.center_px[a])),
        by_px: [0, 1].map(|a| pair.focal_px[a] * (t[a] - slope[a] * t[2]) * inv_z),
    }
}

/// Second moments of two patches about their means.
struct Correlation {
    means: [f32; 2],
    variances: [f32; 2],
    covariance: f32,
}

impl Correlation {
    #[inline(always)]
    fn of<L: Lanes, const PATCH: usize>(a: &[f32; PATCH], b: &[f32; PATCH]) -> Self {
        let n = PATCH as f32;
        let means = [a, b].map(|patch| patch.iter().sum::<f32>() / n);
        let (mut aa, mut bb, mut ab) = (0.0, 0.0, 0.0);
        for (a, b) in a.iter().zip(b) {
            let (a, b) = (a - means[0], b - means[1]);
            (aa, bb, ab) = (L::fused(a, a, aa), L::fused(b, b, bb), L::fused(a, b, ab));
        }
        Self { means, variances: [aa / n, bb / n], covariance: ab / n }
    }

    fn scale(&self) -> f32 {
        1.0 / (self.variances[0] * self.variances[1] + VARIANCES_MIN)
    }

    fn disagreement(&self) -> f32 {
        1.0 - self.covariance * self.covariance * self.scale()
    }

    /// The derivative of [`Self::disagreement`] with respect to each pixel of the second patch.
    fn by_second<const PATCH: usize>(&self, a: &[f32; PATCH], b: &[f32; PATCH]) -> [f32; PATCH] {
        let scale = self.scale();
        let by_covariance = -2.0 * self.covariance * scale / PATCH as f32;
        let ratio = self.covariance * scale;
        let by_variance = 2.0 * ratio * ratio * self.variances[0] / PATCH as f32;
        std::array::from_fn(|i| by_covariance * (a[i] - self.means[0]) + by_variance * (b[i] - self.means[1]))
    }
}

fn add(image: &TileImage, sampled: &Sampled, given: &PlaneGradient, gradient: &mut [Row]) {
    let (tile_x, lane) = (sampled.x / TILE, sampled.x % TILE);
    for (axis, v) in given.normal.into_iter().enumerate() {
        gradient[band_row(image, NORMAL + axis, sampled.y, tile_x)].0[lane] += v;
    }
    gradient[band_row(image, DISTANCE, sampled.y, tile_x)].0[lane] += given.distance;
}
