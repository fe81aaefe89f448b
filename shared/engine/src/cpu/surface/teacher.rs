//! The losses of distillation: depth and blended normals agree with a teacher's (CoSurfGS, "Model Aggregation
//! Scheme", `L_d` and `L_n`).
//!
//! Means over all pixels of `t |z - z'|` and `t |N - N'|₁`, with t the trust in the teacher's pixel; depths count
//! where both have one. Gradients go to N here, and through z to D and N.

use rayon::prelude::*;

use super::super::image::{TILE, TileImage};
use super::super::rasterize::NORMAL;
use super::super::simd::{Isa, Kernel, Lanes, Row};
use super::normals::through_depth;
use super::plane::Plane;
use super::{Shown, band_row, bands};
use crate::backend::{TargetSurface, TeacherLoss, TeacherWeights};

/// The losses, not weighted; adds their weighted gradients to `gradient`.
pub(super) fn loss(
    isa: Isa,
    scene: &Shown,
    target: &TargetSurface,
    weights: &TeacherWeights,
    gradient: &mut TileImage,
) -> TeacherLoss {
    let [width, height] = scene.image.size_px();
    let pixels = (width * height) as f32;
    let weights = [weights.depth / pixels, weights.normal / pixels];
    let sums: Vec<[f64; 2]> = bands(scene.image, gradient)
        .map(|(band, gradient)| isa.run(TeacherBand { scene: *scene, target, weights, band, gradient }))
        .collect();
    let [depth, normal] = sums.into_iter().fold([0.0; 2], |a, b| [a[0] + b[0], a[1] + b[1]]);
    TeacherLoss { depth: depth / f64::from(pixels), normal: normal / f64::from(pixels) }
}

struct TeacherBand<'a> {
    scene: Shown<'a>,
    target: &'a TargetSurface<'a>,
    /// Of the depth and the normal of one pixel.
    weights: [f32; 2],
    band: usize,
    gradient: &'a mut [Row],
}

/// One row of the teacher's picture in lines with margins, as those of a [`Plane`].
struct Lines {
    depth: Vec<f32>,
    trust: Vec<f32>,
    normal: [Vec<f32>; 3],
}

impl Lines {
    fn new(stride: usize) -> Self {
        let line = || vec![0.0; stride];
        Self { depth: line(), trust: line(), normal: [line(), line(), line()] }
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
    /// Sums over the band's pixels.
    type Output = [f64; 2];

    #[inline(always)]
    fn run<L: Lanes>(self) -> [f64; 2] {
        let Self { scene, target, weights, band, gradient } = self;
        let stride = scene.depth.stride();
        let (mut lines, mut v_depth) = (Lines::new(stride), vec![0.0; stride]);
        let mut sums = [0.0; 2];
        for y in scene.rows(band) {
            lines.read(target, y, scene.image.size_px()[0]);
            let depths = scene.depth.line(y as isize);
            let (mut depth_sum, mut normal_sum) = (L::zero(), L::zero());
            for tile_x in 0..scene.image.tiles()[0] {
                for part in 0..TILE / L::N {
                    let place = Plane::at((tile_x * TILE + part * L::N) as isize);
                    let load = |line: &[f32]| L::load(&line[place..]);
                    let trust = load(&lines.trust);
                    let (z, wanted) = (load(depths), load(&lines.depth));
                    let both = L::and(L::zero().lt(z), L::zero().lt(wanted));
                    let off = (z - wanted).keep(both);
                    depth_sum = trust.mul_add(off.abs(), depth_sum);
                    signed(off, trust * L::splat(weights[0])).store(&mut v_depth[place..]);
                    for axis in 0..3 {
                        let blended = scene.image.row(NORMAL + axis, y, tile_x).get::<L>(part);
                        let off = blended - load(&lines.normal[axis]);
                        normal_sum = trust.mul_add(off.abs(), normal_sum);
                        let row = &mut gradient[band_row(scene.image, NORMAL + axis, y, tile_x)];
                        let sum = row.get::<L>(part) + signed(off, trust * L::splat(weights[1]));
                        row.set(part, sum);
                    }
                }
            }
            through_depth::<L>(&scene, y, &v_depth, gradient);
            sums[0] += f64::from(depth_sum.sum());
            sums[1] += f64::from(normal_sum.sum());
        }
        sums
    }
}

/// `scale` with the sign of `value`; 0 for 0.
#[inline(always)]
fn signed<L: Lanes>(value: L, scale: L) -> L {
    L::select(L::zero().lt(value), scale, scale.neg().keep(value.lt(L::zero())))
}
