//! The single-view normal loss (`L_svg` of PGSR): the difference between blended normals and normals from depth. Edges
//! of the photograph have a lower weight.
//!
//! A pixel with the depth `z` and the ray `r` shows the point `P = z r`. The points of the four pixels at a distance of
//! `k` px (`NORMAL_REACH`) give `h = P(x+k) - P(x-k)` and `v = P(y-k) - P(y+k)`. The normal from depth is
//! `n = h × v / |h × v|`, which faces the camera.
//!
//! The loss is the mean over pixels of `w |α n - N|₁`, with the blended normal `N` and the alpha `α` of the pixel,
//! which is held constant. It is 0 if the pixel or one of the four is masked. The weight is `w = (1 - ĝ)²`, where `ĝ` is the
//! slope of the photograph (the larger central difference of luma), scaled to 0..=1 over the picture. Gradients are computed with respect to `N`, and through `n`
//! with respect to the depths of the four pixels.

use rayon::prelude::*;

use super::super::scratch::{PerThread, zeros};
use super::depth::{Rays, ray_y};
use super::plane::Plane;
use super::shown::{Shown, band_row, bands};
use crate::layout::constants::{MASKED_LUMA, NORMAL_REACH as REACH};
use crate::layout::planes::{DISTANCE, NORMAL, TRANSMITTANCE};
use crate::layout::tiles::{TILE, TileImage};
use crate::simd::{Isa, Kernel, Lanes, Row, Total, cross3, dot3, each};

/// The loss with its scratch memory.
#[derive(Debug)]
pub(super) struct Normals {
    /// Smallest and largest slope of each inner row of the picture.
    slopes: Vec<[f32; 2]>,
    /// Sum of the loss in each band.
    sums: Vec<f64>,
}

impl Normals {
    /// Memory for pictures up to `size_px`.
    pub(super) fn with_capacity(size_px: [u32; 2]) -> Self {
        Self {
            slopes: Vec::with_capacity(size_px[1] as usize),
            sums: Vec::with_capacity(TileImage::tiles_of(size_px)[1]),
        }
    }

    /// Returns the loss without its weight, and writes `weight` times its gradient to `gradient`, whose geometry planes
    /// must be zero.
    pub(super) fn loss(
        &mut self,
        isa: Isa,
        scene: &Shown,
        weight: f32,
        gradient: &mut TileImage,
        v_depth: &PerThread<Vec<f32>>,
    ) -> f64 {
        let [width, height] = scene.image.size_px();
        let pixels = (width * height) as f32;
        let edges = Edges::of(isa, scene.luma, height, &mut self.slopes);
        self.sums.resize(scene.image.tiles()[1], 0.0);
        bands(scene.image, gradient).zip(self.sums.par_iter_mut()).for_each(|((band, gradient), sum)| {
            *sum = v_depth.with(|v_depth| {
                let weight = weight / pixels;
                isa.run(NormalBand { scene: *scene, edges, weight, band, gradient, v_depth })
            });
        });
        self.sums.iter().sum::<f64>() / f64::from(pixels)
    }
}

/// The range of the slopes of luma in the picture. It scales slopes to 0..=1.
#[derive(Clone, Copy)]
struct Edges {
    least: f32,
    inv_range: f32,
}

impl Edges {
    fn of(isa: Isa, luma: &Plane, height: usize, slopes: &mut Vec<[f32; 2]>) -> Self {
        slopes.resize(height.saturating_sub(2), [0.0; 2]);
        slopes
            .par_iter_mut()
            .enumerate()
            .for_each(|(above, range)| *range = isa.run(SlopeLine { luma, y: above + 1 }));
        let none = [f32::INFINITY, f32::NEG_INFINITY];
        let [least, most] = slopes.iter().fold(none, |a, b| [a[0].min(b[0]), a[1].max(b[1])]);
        let range = most - least;
        if range > 0.0 { Self { least, inv_range: 1.0 / range } } else { Self { least: 0.0, inv_range: 0.0 } }
    }
}

struct SlopeLine<'a> {
    luma: &'a Plane,
    y: usize,
}

impl Kernel for SlopeLine<'_> {
    /// Smallest and largest slope of the inner pixels of the line.
    type Output = [f32; 2];

    #[inline(always)]
    fn run<L: Lanes>(self) -> [f32; 2] {
        let mut row = Row::ZERO;
        let (mut least, mut most) = (f32::INFINITY, f32::NEG_INFINITY);
        let width = self.luma.size_px()[0];
        for column in (0..width).step_by(L::N) {
            slope::<L>(self.luma, self.y, column).store(&mut row.0);
            let first = usize::from(column == 0);
            let end = L::N.min((width - 1).saturating_sub(column));
            for value in row.0.iter().take(end).skip(first) {
                (least, most) = (least.min(*value), most.max(*value));
            }
        }
        [least, most]
    }
}

/// The larger absolute value of the two central differences of luma. Not a number if one of these pixels is masked.
#[inline(always)]
fn slope<L: Lanes>(luma: &Plane, y: usize, column: usize) -> L {
    let [right, left, above, below] = around::<L>(luma, y, column, 1);
    let slope = (right - left).abs().max((above - below).abs());
    let own = L::load(&luma.line(y as isize)[Plane::at(column as isize)..]);
    let least = right.min(left).min(above.min(below)).min(own);
    L::select(L::splat(MASKED_LUMA).lt(least), slope, L::splat(f32::NAN))
}

/// The luma of the pixels to the right, to the left, above and below, `reach` px away.
#[inline(always)]
fn around<L: Lanes>(luma: &Plane, y: usize, column: usize, reach: usize) -> [L; 4] {
    let (x, k) = (column as isize, reach as isize);
    let line = luma.line(y as isize);
    let (above, below) = (luma.line(y as isize - k), luma.line(y as isize + k));
    [
        L::load(&line[Plane::at(x + k)..]),
        L::load(&line[Plane::at(x - k)..]),
        L::load(&above[Plane::at(x)..]),
        L::load(&below[Plane::at(x)..]),
    ]
}

struct NormalBand<'a> {
    scene: Shown<'a>,
    edges: Edges,
    /// Weight of one pixel.
    weight: f32,
    band: usize,
    gradient: &'a mut [Row],
    v_depth: &'a mut Vec<f32>,
}

impl Kernel for NormalBand<'_> {
    /// Sum of the loss over the band's pixels.
    type Output = f64;

    #[inline(always)]
    fn run<L: Lanes>(self) -> f64 {
        let Self { scene, edges, weight, band, gradient, v_depth } = self;
        let height = scene.image.size_px()[1];
        let rows = scene.rows(band);
        let stride = scene.depth.stride();
        // Gradient with respect to the depths of the band's rows. The loss of a row depends on depths above and below
        // it. So the rows next to the band are computed here too, for their gradients with respect to depths in the
        // band.
        zeros(v_depth, stride * rows.len());
        let mut sum = 0.0;
        for y in rows.start.max(2 * REACH) - REACH..(rows.end + REACH).min(height.saturating_sub(REACH)) {
            let own = rows.contains(&y);
            let mut line = Total::<L>::zero();
            for tile_x in 0..scene.image.tiles()[0] {
                for part in 0..TILE / L::N {
                    let column = tile_x * TILE + part * L::N;
                    let pixel = Pixels::<L>::new(&scene, edges, y, column);
                    if !L::any(pixel.valid) {
                        continue;
                    }
                    let (loss, v) = pixel.gradients(L::splat(weight));
                    if own {
                        line[part] = line[part] + loss;
                        for (axis, v) in v.normal.into_iter().enumerate() {
                            gradient[band_row(scene.image, NORMAL + axis, y, tile_x)].set(part, v);
                        }
                    }
                    let mut add = |y: usize, x: isize, v: L| {
                        if rows.contains(&y) {
                            let place = &mut v_depth[(y - rows.start) * stride + Plane::at(x)..];
                            (L::load(place) + v).store(place);
                        }
                    };
                    let (x, k) = (column as isize, REACH as isize);
                    add(y, x + k, v.right);
                    add(y, x - k, v.left);
                    add(y - REACH, x, v.above);
                    add(y + REACH, x, v.below);
                }
            }
            sum += f64::from(line.sum());
        }
        for y in rows.clone() {
            through_depth::<L>(&scene, y, &v_depth[(y - rows.start) * stride..][..stride], gradient);
        }
        sum
    }
}

/// A vector of pixels with rays, normals and weights.
struct Pixels<L: Lanes> {
    /// Rays of the pixels to the right, to the left, above and below.
    rays: [[L; 3]; 4],
    /// Difference of the points to the right and to the left.
    h: [L; 3],
    /// Difference of the points above and below.
    v: [L; 3],
    /// 1 / length of `h × v`; 0 if a pixel is not valid.
    inv_length: L,
    /// Normal from depth.
    n: [L; 3],
    blended: [L; 3],
    alpha: L,
    edge_weight: L,
    /// True if the four depths give a normal, and neither they nor the pixel are masked.
    valid: L::Mask,
}

/// Gradients of the loss of one vector of pixels, with respect to the blended normals and to the four depths around
/// each pixel.
struct Gradients<L> {
    normal: [L; 3],
    right: L,
    left: L,
    above: L,
    below: L,
}

impl<L: Lanes> Pixels<L> {
    #[inline(always)]
    fn new(scene: &Shown, edges: Edges, y: usize, column: usize) -> Self {
        let (tile_x, part) = (column / TILE, column % TILE / L::N);
        let (x, k) = (column as isize, REACH as isize);
        let depth = |x: isize, y: usize| L::load(&scene.depth.line(y as isize)[Plane::at(x)..]);
        let z = [depth(x + k, y), depth(x - k, y), depth(x, y - REACH), depth(x, y + REACH)];
        let rays = Rays::<L>::new(scene.view, y);
        let (ray_x, one) = (rays.x(column), L::splat(1.0));
        let row_y = |y: f32| L::splat(ray_y(scene.view, y));
        let reach = REACH as f32;
        let across = rays.step_x() * L::splat(reach);
        let rays = [
            [ray_x + across, rays.y, one],
            [ray_x - across, rays.y, one],
            [ray_x, row_y(y as f32 - reach), one],
            [ray_x, row_y(y as f32 + reach), one],
        ];
        let point = |k: usize| each!([0, 1, 2], |a| z[k] * rays[k][a]);
        let (right, left, above, below) = (point(0), point(1), point(2), point(3));
        let h = each!([0, 1, 2], |a| right[a] - left[a]);
        let v = each!([0, 1, 2], |a| above[a] - below[a]);
        let c = cross3(h, v);
        let length2 = dot3(c, c);
        let zero = L::zero();
        let near = L::and(L::and(zero.lt(z[0]), zero.lt(z[1])), L::and(zero.lt(z[2]), zero.lt(z[3])));
        let own = L::load(&scene.luma.line(y as isize)[Plane::at(column as isize)..]);
        let lumas = around::<L>(scene.luma, y, column, REACH).into_iter().fold(own, L::min);
        let shown = L::and(near, L::splat(MASKED_LUMA).lt(lumas));
        let valid = L::and(shown, L::splat(1e-30).lt(length2));
        let inv_length = (one / L::select(valid, length2, one).sqrt()).keep(valid);
        let get = |plane: usize| scene.image.row(plane, y, tile_x).get::<L>(part);
        let steepness =
            (slope::<L>(scene.luma, y, column) - L::splat(edges.least)) * L::splat(edges.inv_range);
        let flatness = one - steepness;
        Self {
            rays,
            h,
            v,
            inv_length,
            n: each!([0, 1, 2], |a| c[a] * inv_length),
            blended: [get(NORMAL), get(NORMAL + 1), get(NORMAL + 2)],
            alpha: one - get(TRANSMITTANCE),
            edge_weight: (flatness * flatness).keep(valid),
            valid,
        }
    }

    /// Returns the loss of the pixels, and its gradients times `weight`.
    #[inline(always)]
    fn gradients(&self, weight: L) -> (L, Gradients<L>) {
        let difference = each!([0, 1, 2], |a| self.alpha.mul_add(self.n[a], L::zero() - self.blended[a]));
        let loss = self.edge_weight * (difference[0].abs() + difference[1].abs() + difference[2].abs());
        let scale = weight * self.edge_weight;
        let signed = each!([0, 1, 2], |a| {
            let d = difference[a];
            L::select(L::zero().lt(d), scale, scale.neg().keep(d.lt(L::zero())))
        });
        let g = each!([0, 1, 2], |a| signed[a] * self.alpha);
        let along = dot3(self.n, g);
        let v_c = each!([0, 1, 2], |a| (g[a] - self.n[a] * along) * self.inv_length);
        // Through the cross product c = h × v.
        let (v_h, v_v) = (cross3(self.v, v_c), cross3(v_c, self.h));
        let gradients = Gradients {
            normal: each!([0, 1, 2], |a| signed[a].neg()),
            right: dot3(v_h, self.rays[0]),
            left: dot3(v_h, self.rays[1]).neg(),
            above: dot3(v_v, self.rays[2]),
            below: dot3(v_v, self.rays[3]).neg(),
        };
        (loss, gradients)
    }
}

/// Propagates `v_depth`, the gradient with respect to the depths `z` of a row, to the gradients of the plane distance
/// `D` and the normal `N`, through `z = D / f` with `f = -(N · r)`.
#[inline(always)]
pub(super) fn through_depth<L: Lanes>(scene: &Shown, y: usize, v_depth: &[f32], gradient: &mut [Row]) {
    let rays = Rays::<L>::new(scene.view, y);
    let depths = scene.depth.line(y as isize);
    for tile_x in 0..scene.image.tiles()[0] {
        for part in 0..TILE / L::N {
            let column = tile_x * TILE + part * L::N;
            let place = Plane::at(column as isize);
            let (z, v_z) = (L::load(&depths[place..]), L::load(&v_depth[place..]));
            let shown = L::zero().lt(z);
            let get = |plane: usize| scene.image.row(plane, y, tile_x).get::<L>(part);
            let ray_x = rays.x(column);
            let facing = rays.facing([get(NORMAL), get(NORMAL + 1), get(NORMAL + 2)], ray_x);
            let v_distance = (v_z / facing).keep(shown);
            let v_facing = v_distance * z;
            let ray = [ray_x, rays.y, L::splat(1.0)];
            for (plane, v) in [
                (DISTANCE, v_distance),
                (NORMAL, v_facing * ray[0]),
                (NORMAL + 1, v_facing * ray[1]),
                (NORMAL + 2, v_facing * ray[2]),
            ] {
                let row = &mut gradient[band_row(scene.image, plane, y, tile_x)];
                let sum = row.get::<L>(part) + v;
                row.set(part, sum);
            }
        }
    }
}
