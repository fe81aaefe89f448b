//! The unbiased depth (PGSR): the depth `z = D / -(N · r)` at which the ray `r` of a pixel meets the blended plane,
//! with the plane distance `D` and the normal `N`. `D` and `N` are blended with the same weights, so alpha cancels.

use rayon::prelude::*;

use super::plane::Plane;
use crate::layout::constants::{GRAZING, SURFACE_ALPHA};
use crate::layout::planes::{DISTANCE, NORMAL, TRANSMITTANCE};
use crate::layout::tiles::{TILE, TileImage, centers};
use crate::layout::view::ViewParams;
use crate::simd::{Isa, Kernel, Lanes};

/// Writes the depth of each pixel along the optical axis, world units; 0 where alpha is below [`SURFACE_ALPHA`] or the
/// ray grazes the plane ([`GRAZING`]).
pub(super) fn unbiased_depth(isa: Isa, image: &TileImage, view: &ViewParams, depth: &mut Plane) {
    depth.reshape(image.size_px());
    depth.lines_mut().enumerate().for_each(|(y, line)| isa.run(DepthLine { image, view, y, line }));
}

struct DepthLine<'a> {
    image: &'a TileImage,
    view: &'a ViewParams,
    y: usize,
    line: &'a mut [f32],
}

impl Kernel for DepthLine<'_> {
    type Output = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let Self { image, view, y, line } = self;
        let rays = Rays::<L>::new(view, y);
        for tile_x in 0..image.tiles()[0] {
            for part in 0..TILE / L::N {
                let get = |plane: usize| image.row(plane, y, tile_x).get::<L>(part);
                let column = tile_x * TILE + part * L::N;
                let facing = rays.facing([get(NORMAL), get(NORMAL + 1), get(NORMAL + 2)], rays.x(column));
                let alpha = L::splat(1.0) - get(TRANSMITTANCE);
                let shown = L::and(alpha.ge(L::splat(SURFACE_ALPHA)), facing.ge(L::splat(GRAZING) * alpha));
                let depth = (get(DISTANCE) / facing).keep(shown);
                depth.store(&mut line[Plane::at(column as isize)..]);
            }
        }
        line[Plane::at(image.size_px()[0] as isize)..].fill(0.0);
    }
}

/// Rays of a row of pixels, scaled to z = 1.
pub(super) struct Rays<L> {
    focal_px: L,
    inv_focal: L,
    center_px: L,
    pub(super) y: L,
}

impl<L: Lanes> Rays<L> {
    #[inline(always)]
    pub(super) fn new(view: &ViewParams, y: usize) -> Self {
        let inv_focal = 1.0 / view.focal_px[0];
        Self {
            focal_px: L::splat(view.focal_px[0]),
            inv_focal: L::splat(inv_focal),
            center_px: L::splat(view.center_px[0]),
            y: L::splat(ray_y(view, y as f32)),
        }
    }

    /// Slopes x / z of one vector of columns, which starts at `column`.
    #[inline(always)]
    pub(super) fn x(&self, column: usize) -> L {
        (centers::<L>(column as f32, 0) - self.center_px) / self.focal_px
    }

    /// Difference of x / z between neighbouring columns.
    #[inline(always)]
    pub(super) fn step_x(&self) -> L {
        self.inv_focal
    }

    /// `-(n · r)` for normals `n` and the rays `r` with slopes `ray_x`.
    #[inline(always)]
    pub(super) fn facing(&self, n: [L; 3], ray_x: L) -> L {
        n[0].mul_add(ray_x, n[1].mul_add(self.y, n[2])).neg()
    }
}

/// Slope y / z of row `y`.
#[inline(always)]
pub(super) fn ray_y(view: &ViewParams, y: f32) -> f32 {
    (y + 0.5 - view.center_px[1]) / view.focal_px[1]
}
