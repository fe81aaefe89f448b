//! The losses of distillation: differences of depth and blended normals from a teacher (CoSurfGS, "Model Aggregation
//! Scheme", `L_d` and `L_n`).
//!
//! The losses are the means over all pixels of `t |z - z'|` and `t |N - N'|₁`. Here `t` is the trust in the teacher's
//! pixel, `z` and `N` are the rendered depth and normal, and `z'` and `N'` those of the teacher. If `z` or `z'` is
//! missing, the pixel adds nothing to the depth loss. Gradients are computed with respect to `N`, and through `z` with
//! respect to the plane distance and `N`.

use rayon::prelude::*;

use super::super::scratch::{PerThread, zeros};
use super::normals::through_depth;
use super::plane::Plane;
use super::shown::{Shown, band_row, bands};
use crate::backend::{TargetSurface, TeacherLoss, TeacherWeights};
use crate::layout::planes::NORMAL;
use crate::layout::tiles::{TILE, TileImage};
use crate::simd::{Isa, Kernel, Lanes, Row, Total};

/// The losses with their scratch memory.
#[derive(Debug)]
pub(super) struct Teacher {
    lines: PerThread<Lines>,
    /// Sums of the differences of depths and normals in each band.
    sums: Vec<[f64; 2]>,
}

impl Teacher {
    /// Memory for pictures up to `size_px` and this many threads, at least 1.
    pub(super) fn with_capacity(size_px: [u32; 2], threads: usize) -> Self {
        Self {
            lines: PerThread::new(threads, || Lines::with_capacity(Plane::stride_for(size_px))),
            sums: Vec::with_capacity(TileImage::tiles_of(size_px)[1]),
        }
    }

    /// Returns the losses without their weights, and adds their weighted gradients to `gradient`.
    pub(super) fn loss(
        &mut self,
        isa: Isa,
        scene: &Shown,
        target: &TargetSurface,
        weights: &TeacherWeights,
        gradient: &mut TileImage,
        v_depth: &PerThread<Vec<f32>>,
    ) -> TeacherLoss {
        let [width, height] = scene.image.size_px();
        let pixels = (width * height) as f32;
        let weights = [weights.depth / pixels, weights.normal / pixels];
        let Self { lines, sums } = self;
        sums.resize(scene.image.tiles()[1], [0.0; 2]);
        bands(scene.image, gradient).zip(sums.par_iter_mut()).for_each(|((band, gradient), sums)| {
            *sums = lines.with(|lines| {
                v_depth.with(|v_depth| {
                    isa.run(TeacherBand { scene: *scene, target, weights, band, gradient, lines, v_depth })
                })
            });
        });
        let [depth, normal] = sums.iter().fold([0.0; 2], |a, b| [a[0] + b[0], a[1] + b[1]]);
        TeacherLoss { depth: depth / f64::from(pixels), normal: normal / f64::from(pixels) }
    }
}

struct TeacherBand<'a> {
    scene: Shown<'a>,
    target: &'a TargetSurface<'a>,
    /// Weights of the depth difference and of the normal difference at one pixel.
    weights: [f32; 2],
    band: usize,
    gradient: &'a mut [Row],
    lines: &'a mut Lines,
    v_depth: &'a mut Vec<f32>,
}

/// One row of the teacher's rendering, in lines with the margins of a [`Plane`].
#[derive(Debug)]
struct Lines {
    depth: Vec<f32>,
    trust: Vec<f32>,
    normal: [Vec<f32>; 3],
}

impl Lines {
    fn with_capacity(stride: usize) -> Self {
        let line = || Vec::with_capacity(stride);
        Self { depth: line(), trust: line(), normal: [line(), line(), line()] }
    }

    /// Sets the length of the lines. All numbers become zero, margins included.
    fn reset(&mut self, stride: usize) {
        let Self { depth, trust, normal } = self;
        [depth, trust].into_iter().chain(normal).for_each(|line| zeros(line, stride));
    }

    fn read(&mut self, target: &TargetSurface, y: usize, width: usize) {
        let (row, inside) = (y * width..(y + 1) * width, Plane::at(0)..Plane::at(width as isize));
        self.depth[inside.clone()].copy_from_slice(&target.depth[row.clone()]);
        self.trust[inside.clone()].copy_from_slice(&target.trust[row.clone()]);
        for (axis, line) in self.normal.iter_mut().enumerate() {
            let normals = target.normal[3 * row.start..3 * row.end].chunks_exact(3);
            line[inside.clone()].iter_mut().zip(normals).for_each(|(value, normal)| *value = normal[axis]);
        }
    }
}

impl Kernel for TeacherBand<'_> {
    /// Sums of the differences of depths and normals over the band's pixels.
    type Output = [f64; 2];

    #[inline(always)]
    fn run<L: Lanes>(self) -> [f64; 2] {
        let Self { scene, target, weights, band, gradient, lines, v_depth } = self;
        let stride = scene.depth.stride();
        lines.reset(stride);
        zeros(v_depth, stride);
        let mut sums = [0.0; 2];
        for y in scene.rows(band) {
            lines.read(target, y, scene.image.size_px()[0]);
            let depths = scene.depth.line(y as isize);
            let (mut depth_sum, mut normal_sum) = (Total::<L>::zero(), Total::<L>::zero());
            for tile_x in 0..scene.image.tiles()[0] {
                for part in 0..TILE / L::N {
                    let place = Plane::at((tile_x * TILE + part * L::N) as isize);
                    let load = |line: &[f32]| L::load(&line[place..]);
                    let trust = load(&lines.trust);
                    let (z, wanted) = (load(depths), load(&lines.depth));
                    let both = L::and(L::zero().lt(z), L::zero().lt(wanted));
                    let off = (z - wanted).keep(both);
                    depth_sum[part] = trust.mul_add(off.abs(), depth_sum[part]);
                    signed(off, trust * L::splat(weights[0])).store(&mut v_depth[place..]);
                    for axis in 0..3 {
                        let blended = scene.image.row(NORMAL + axis, y, tile_x).get::<L>(part);
                        let off = blended - load(&lines.normal[axis]);
                        normal_sum[part] = trust.mul_add(off.abs(), normal_sum[part]);
                        let row = &mut gradient[band_row(scene.image, NORMAL + axis, y, tile_x)];
                        let sum = row.get::<L>(part) + signed(off, trust * L::splat(weights[1]));
                        row.set(part, sum);
                    }
                }
            }
            through_depth::<L>(&scene, y, v_depth, gradient);
            sums[0] += f64::from(depth_sum.sum());
            sums[1] += f64::from(normal_sum.sum());
        }
        sums
    }
}

/// `scale` with the sign of `value`; 0 where `value` is 0.
#[inline(always)]
fn signed<L: Lanes>(value: L, scale: L) -> L {
    L::select(L::zero().lt(value), scale, scale.neg().keep(value.lt(L::zero())))
}
