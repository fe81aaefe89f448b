//! The surface losses (PGSR; CoSurfGS, "Device-side Training Procedure"), and their gradients with respect to the
//! blended normal and plane distance of each pixel.
//!
//! All losses are computed in bands of one row of tiles, so the sums do not depend on the number of threads. Reading
//! order: [`plane`] for the layout, [`depth`], then the losses: [`normals`], [`multiview`], and [`teacher`] for
//! distillation.

mod depth;
mod multiview;
mod normals;
mod plane;
mod shown;
mod teacher;

use rayon::prelude::*;

use super::scratch::PerThread;
use crate::backend::{SurfaceLoss, SurfaceWeights, TargetSurface, Targets, TeacherLoss, TeacherWeights};
use crate::layout::planes::NORMAL;
use crate::layout::tiles::{TILE, TileImage};
use crate::layout::view::ViewParams;
use crate::simd::{Isa, Row};
use multiview::{Multiview, Pair};
use normals::Normals;
use plane::Plane;
use shown::Shown;
use teacher::Teacher;

/// The surface losses, with the depth and luma planes of a view and of its neighbouring view.
#[derive(Debug)]
pub(crate) struct Surface {
    depth: Plane,
    luma: Plane,
    neighbour_depth: Plane,
    neighbour_luma: Plane,
    neighbour: Option<ViewParams>,
    normals: Normals,
    multiview: Multiview,
    teacher: Teacher,
    /// Gradient of the loss with respect to the depths of the pixels of a band.
    v_depth: PerThread<Vec<f32>>,
}

impl Surface {
    /// Memory for pictures up to `size_px` and this many threads, at least 1.
    pub(crate) fn with_capacity(size_px: [u32; 2], threads: usize) -> Self {
        let plane = || Plane::with_capacity(size_px);
        Self {
            depth: plane(),
            luma: plane(),
            neighbour_depth: plane(),
            neighbour_luma: plane(),
            neighbour: None,
            normals: Normals::with_capacity(size_px),
            multiview: Multiview::with_capacity(size_px),
            teacher: Teacher::with_capacity(size_px, threads),
            v_depth: PerThread::new(threads, || Vec::with_capacity(TILE * Plane::stride_for(size_px))),
        }
    }

    /// Keeps the depth of `image` and the camera `view` as those of the neighbouring view.
    pub(crate) fn keep_neighbour(&mut self, isa: Isa, image: &TileImage, view: &ViewParams) {
        depth::unbiased_depth(isa, image, view, &mut self.neighbour_depth);
        self.neighbour = Some(*view);
    }

    /// Returns the losses and writes their weighted gradients to the geometry planes of `gradient`.
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
            normal: self.normals.loss(isa, &scene, weights.normal, gradient, &self.v_depth),
            ..SurfaceLoss::default()
        };
        if let (Some(weights), Some(rgb), Some(neighbour)) =
            (&weights.multiview, targets.neighbour_rgb, &self.neighbour)
        {
            plane::luma(rgb, neighbour.size_px, &mut self.neighbour_luma);
            let pair = Pair::new(view, neighbour, &self.neighbour_depth, &self.neighbour_luma);
            self.multiview.loss(isa, &scene, &pair, weights, gradient, &mut loss);
        }
        loss
    }

    /// Returns the differences from a teacher and adds their weighted gradients to the geometry planes of `gradient`.
    /// Must follow [`Self::losses`], which computes the depth of `image`.
    pub(crate) fn teach(
        &mut self,
        isa: Isa,
        image: &TileImage,
        view: &ViewParams,
        target: &TargetSurface,
        weights: &TeacherWeights,
        gradient: &mut TileImage,
    ) -> TeacherLoss {
        let scene = Shown { image, view, depth: &self.depth, luma: &self.luma };
        self.teacher.loss(isa, &scene, target, weights, gradient, &self.v_depth)
    }
}

/// Sets the gradients of normal and plane distance to zero.
fn clear_geometry(gradient: &mut TileImage) {
    let rows_per_tile = gradient.rows_per_tile();
    gradient
        .rows_mut()
        .par_chunks_exact_mut(rows_per_tile)
        .for_each(|tile| tile[NORMAL * TILE..].fill(Row::ZERO));
}
