//! The losses of the surface (PGSR; CoSurfGS, "Device-side Training Procedure"), and their gradients with
//! respect to the blended normal and plane distance of each pixel.
//!
//! Everything here runs on bands of one row of tiles, so the sums do not depend on threads. Reading order:
//! [`plane`] for the layout, [`depth`], then the losses: [`normals`], [`multiview`], and [`teacher`] where another
//! model shows how it should be.

mod depth;
pub(crate) mod multiview;
pub(super) mod normals;
mod plane;
mod teacher;

use rayon::prelude::*;

use super::image::{TILE, TileImage};
use super::rasterize::NORMAL;
use super::simd::{Isa, Row};
use super::view::ViewParams;
use crate::backend::{
    SurfaceLoss, SurfaceWeights, TargetRgb, TargetSurface, Targets, TeacherLoss, TeacherWeights,
};
use multiview::Pair;
pub(crate) use plane::Plane;

pub(crate) use depth::{GRAZING, SURFACE_ALPHA};

/// Planes as large as the largest picture.
pub(crate) const PLANES: usize = 4;

/// What the losses keep from view to view.
#[derive(Debug)]
pub(crate) struct Surface {
    depth: Plane,
    luma: Plane,
    neighbour_depth: Plane,
    neighbour_luma: Plane,
    neighbour: Option<ViewParams>,
}

impl Surface {
    /// Room for pictures up to `size_px`.
    pub(crate) fn with_capacity(size_px: [u32; 2]) -> Self {
        let plane = || Plane::with_capacity(size_px);
        Self {
            depth: plane(),
            luma: plane(),
            neighbour_depth: plane(),
            neighbour_luma: plane(),
            neighbour: None,
        }
    }

    /// Takes the depth of `image` as the neighbour's.
    pub(crate) fn keep_neighbour(&mut self, isa: Isa, image: &TileImage, view: &ViewParams) {
        depth::unbiased_depth(isa, image, view, &mut self.neighbour_depth);
        self.neighbour = Some(*view);
    }

    /// The losses, weighted gradients of which go to the geometry planes of `gradient`.
    pub(crate) fn losses(
        &mut self,
        isa: Isa,
        image: &TileImage,
        view: &ViewParams,
        targets: &Targets,
        weights: &SurfaceWeights,
        gradient: &mut TileImage,
    ) -> SurfaceLoss {
        depth::unbiased_depth(isa, image, view, &mut self.depth);
        plane::luma(targets.rgb, view.size_px, &mut self.luma);
        clear_geometry(gradient);
        let scene = Shown { image, view, depth: &self.depth, luma: &self.luma };
        let mut loss = SurfaceLoss {
            normal: normals::loss(isa, &scene, weights.normal, gradient),
            ..SurfaceLoss::default()
        };
        if let (Some(rgb), Some(neighbour)) = (targets.neighbour_rgb, &self.neighbour) {
            plane::luma(rgb, neighbour.size_px, &mut self.neighbour_luma);
            let pair = Pair::new(view, neighbour, &self.neighbour_depth, &self.neighbour_luma);
            multiview::loss(&scene, &pair, weights, gradient, &mut loss);
        }
        loss
    }

    /// The differences from a teacher, weighted gradients of which are added to the geometry planes of `gradient`.
    /// [`Self::losses`] comes first.
    pub(crate) fn teach(
        &self,
        isa: Isa,
        image: &TileImage,
        view: &ViewParams,
        target: &TargetSurface,
        weights: &TeacherWeights,
        gradient: &mut TileImage,
    ) -> TeacherLoss {
        let scene = Shown { image, view, depth: &self.depth, luma: &self.luma };
        teacher::loss(isa, &scene, target, weights, gradient)
    }
}

/// A rendering and what belongs to it.
#[derive(Clone, Copy)]
struct Shown<'a> {
    image: &'a TileImage,
    view: &'a ViewParams,
    depth: &'a Plane,
    luma: &'a Plane,
}

impl Shown<'_> {
    /// Rows of the picture in the `band`-th row of tiles.
    fn rows(&self, band: usize) -> std::ops::Range<usize> {
        band * TILE..((band + 1) * TILE).min(self.image.size_px()[1])
    }
}

/// Normal and distance have no gradient yet.
fn clear_geometry(gradient: &mut TileImage) {
    let rows_per_tile = gradient.rows_per_tile();
    gradient
        .rows_mut()
        .par_chunks_exact_mut(rows_per_tile)
        .for_each(|tile| tile[NORMAL * TILE..].fill(Row::ZERO));
}

/// Where in a band of gradient rows the pixel row `y` of a plane of the tile `tile_x` lies.
fn band_row(image: &TileImage, plane: usize, y: usize, tile_x: usize) -> usize {
    tile_x * image.rows_per_tile() + plane * TILE + y % TILE
}

/// One band of gradient rows for each row of tiles.
fn bands<'a>(
    image: &TileImage,
    gradient: &'a mut TileImage,
) -> impl IndexedParallelIterator<Item = (usize, &'a mut [Row])> {
    let band_rows = image.tiles()[0] * image.rows_per_tile();
    gradient.rows_mut().par_chunks_exact_mut(band_rows).enumerate()
}

impl TargetRgb<'_> {
    /// Luma of row `y`, Rec. 601 weights, 0..=1.
    fn luma_line(&self, y: usize, width: usize, line: &mut [f32]) {
        const WEIGHTS: [f32; 3] = [0.299, 0.587, 0.114];
        let range = 3 * y * width..3 * (y + 1) * width;
        match self {
            Self::Bytes(rgb) => {
                let weights = WEIGHTS.map(|w| w / 255.0);
                for (value, pixel) in line.iter_mut().zip(rgb[range].chunks_exact(3)) {
                    *value = (0..3).map(|c| weights[c] * f32::from(pixel[c])).sum();
                }
            }
            Self::Floats(rgb) => {
                for (value, pixel) in line.iter_mut().zip(rgb[range].chunks_exact(3)) {
                    *value = (0..3).map(|c| WEIGHTS[c] * pixel[c]).sum();
                }
            }
        }
    }
}
