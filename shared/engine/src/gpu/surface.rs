//! The passes of the surface losses on the GPU, and their buffers.

use super::buffer::Buffer;
use super::context::{Gpu, GpuError};
use super::draw::Drawing;
use super::pass::{Constants, Pass};
use super::recorder::Recorder;
use super::sort::GROUP;
use super::structs::{Pair, SurfaceWeights};
use super::train::Training;
use crate::backend::{
    LossWeights, MultiviewWeights, PatchSide, SurfaceLoss, TargetRgb, TargetSurface, Targets, TeacherLoss,
};
use crate::budget::TAUGHT_NUMBERS;
use crate::layout::sampling::cells;
use crate::layout::tiles::padded_pixels;
use crate::layout::view::{RelativePose, ViewParams};

/// Number of samples that one workgroup processes, as in `multiview.wgsl`.
pub(super) const SAMPLES_AT_ONCE: usize = 64;
/// Initial bits of the smallest and the largest slope for the pass `edges`: infinity and 0.
const NO_SLOPES: [u32; 2] = [f32::INFINITY.to_bits(), 0];

/// The setting of the pass `multiview` for patches of this side.
pub(super) fn reach_of(patch: PatchSide) -> Constants {
    match patch {
        PatchSide::Px3 => &[("PATCH_REACH", 1.0)],
        PatchSide::Px7 => &[("PATCH_REACH", 3.0)],
    }
}

#[derive(Debug)]
struct Passes {
    unbiased_depth: Pass,
    luma: Pass,
    edges: Pass,
    normals: Pass,
    depth_backward: Pass,
    /// For [`PatchSide::Px3`].
    multiview: Pass,
    teacher: Pass,
}

/// Depth and luma of a view: one number for each pixel, row by row.
#[derive(Debug)]
struct Planes {
    depth: Buffer<f32>,
    luma: Buffer<f32>,
}

/// The passes of the surface losses and their buffers.
#[derive(Debug)]
pub(super) struct Surface {
    passes: Passes,
    weights: Buffer<SurfaceWeights>,
    pair: Buffer<Pair>,
    /// Depth and luma of the view that is trained.
    here: Planes,
    /// Depth and luma of the neighbouring view.
    there: Planes,
    /// Bits of the smallest and the largest slope of the photograph.
    slopes: Buffer<u32>,
    /// Gradient of each pixel's normal loss with respect to the depths of the four pixels beside it.
    given: Buffer<[f32; 4]>,
    /// The teacher's depths, then trusts, then normals.
    shown: Buffer<f32>,
    /// Sums of losses: one entry for each tile, then one for each workgroup of samples.
    pub(super) sums: Buffer<[f32; 4]>,
    /// Camera of the neighbouring view; `None` before [`Self::keep_neighbour`].
    neighbour: Option<ViewParams>,
}

impl Planes {
    fn new(gpu: &Gpu, pixels: usize) -> Result<Self, GpuError> {
        Ok(Self {
            depth: Buffer::storage(gpu, "depth", pixels)?,
            luma: Buffer::storage(gpu, "luma", pixels)?,
        })
    }
}

impl Surface {
    /// Allocates room for pictures of up to `size_px`.
    pub(super) fn new(gpu: &Gpu, size_px: [u32; 2]) -> Result<Self, GpuError> {
        let pixels = padded_pixels(size_px);
        let zeroed = bytemuck::Zeroable::zeroed;
        Ok(Self {
            passes: Passes {
                unbiased_depth: gpu.pass(cosurf_shaders::UNBIASED_DEPTH),
                luma: gpu.pass(cosurf_shaders::LUMA),
                edges: gpu.pass(cosurf_shaders::EDGES),
                normals: gpu.pass(cosurf_shaders::NORMALS),
                depth_backward: gpu.pass(cosurf_shaders::DEPTH_BACKWARD),
                multiview: gpu.pass_with(cosurf_shaders::MULTIVIEW, reach_of(PatchSide::Px3)),
                teacher: gpu.pass(cosurf_shaders::TEACHER),
            },
            weights: Buffer::uniform(gpu, "surface weights", zeroed()),
            pair: Buffer::uniform(gpu, "pair of views", bytemuck::Zeroable::zeroed()),
            here: Planes::new(gpu, pixels)?,
            there: Planes::new(gpu, pixels)?,
            slopes: Buffer::storage(gpu, "slopes", 2)?,
            given: Buffer::storage(gpu, "gradients of depths", pixels)?,
            shown: Buffer::storage(gpu, "teacher's surface", TAUGHT_NUMBERS * pixels)?,
            sums: Buffer::storage(gpu, "surface sums", pixels / GROUP + pixels.div_ceil(SAMPLES_AT_ONCE))?,
            neighbour: None,
        })
    }

    /// Keeps the depth and the camera of the current picture as those of the neighbour.
    pub(super) fn keep_neighbour(&mut self, gpu: &Gpu, drawing: &Drawing) {
        let mut r = Recorder::new(gpu);
        self.unbiased_depth(&mut r, drawing, &self.there);
        r.submit();
        self.neighbour = Some(*drawing.seen_view());
    }

    fn unbiased_depth(&self, r: &mut Recorder, drawing: &Drawing, to: &Planes) {
        let buffers = [&drawing.view.raw, &drawing.picture.image.raw, &to.depth.raw];
        r.run(&self.passes.unbiased_depth, &buffers, drawing.tiles());
    }

    /// Computes the sums of the losses, which [`Summed::losses`] takes, and writes their weighted gradients to the normal and
    /// distance planes of the gradient in `training`. If `weights.surface` is `None`, computes and writes nothing. Must be
    /// called after [`Training::photometric`], which uploads the photograph.
    pub(super) fn losses(
        &self,
        gpu: &Gpu,
        drawing: &Drawing,
        training: &Training,
        targets: &Targets,
        weights: &LossWeights,
    ) -> Summed {
        let Some(surface_weights) = &weights.surface else { return Summed::default() };
        let view = drawing.seen_view();
        let pixels = f64::from(view.size_px[0]) * f64::from(view.size_px[1]);
        let pair = targets.neighbour_rgb.zip(self.neighbour.as_ref());
        let multiview = surface_weights.multiview.zip(pair);
        let patch = PatchSide::default();
        let no_samples = MultiviewWeights { reprojection: 0.0, ncc: 0.0, cell_px: 1, patch, draw: 0 };
        let MultiviewWeights { reprojection, ncc, cell_px, patch, draw } =
            multiview.map_or(no_samples, |(w, _)| w);
        let samples = if multiview.is_some() { cells(view.size_px, cell_px) } else { 0 };
        let each_pixel = |weight: f32| weight / pixels as f32;
        let each_sample = |weight: f32| weight / samples.max(1) as f32;
        self.slopes.write(gpu, 0, &NO_SLOPES);
        self.weights.write(
            gpu,
            0,
            &[SurfaceWeights {
                normal: each_pixel(surface_weights.normal),
                reprojection: each_sample(reprojection),
                ncc: each_sample(ncc),
                teacher_depth: each_pixel(weights.teacher.map_or(0.0, |teacher| teacher.depth)),
                teacher_normal: each_pixel(weights.teacher.map_or(0.0, |teacher| teacher.normal)),
                samples: samples as u32,
                sums_first: drawing.tiles() as u32,
                cell_px,
                draw: [draw as u32, (draw >> 32) as u32],
            }],
        );
        self.single_view(gpu, drawing, training);
        if let Some((_, (rgb, neighbour))) = multiview {
            self.multiview(gpu, drawing, training, (rgb, neighbour), samples, patch);
        }
        let taught = weights.teacher.is_some() && targets.surface.is_some();
        if let (Some(_), Some(target)) = (&weights.teacher, &targets.surface) {
            self.teach(gpu, drawing, training, target);
        }
        Summed { tiles: drawing.tiles(), samples, pixels, taught }
    }

    /// Computes the single-view normal loss. Overwrites the normal and distance planes of the gradient.
    fn single_view(&self, gpu: &Gpu, drawing: &Drawing, training: &Training) {
        let (view, image) = (&drawing.view.raw, &drawing.picture.image.raw);
        let Planes { depth, luma } = &self.here;
        let (weights, slopes, given) = (&self.weights.raw, &self.slopes.raw, &self.given.raw);
        let (gradient, sums) = (&training.gradient.raw, &self.sums.raw);
        let mut r = Recorder::new(gpu);
        self.unbiased_depth(&mut r, drawing, &self.here);
        self.luma(&mut r, training, drawing.pixels(), &self.here);
        r.run(&self.passes.edges, &[view, &luma.raw, slopes], drawing.tiles());
        let buffers = [view, weights, image, &depth.raw, &luma.raw, slopes, gradient, given, sums];
        r.run(&self.passes.normals, &buffers, drawing.tiles());
        let buffers = [view, image, &depth.raw, given, gradient];
        r.run(&self.passes.depth_backward, &buffers, drawing.tiles());
        r.submit();
    }

    fn luma(&self, r: &mut Recorder, training: &Training, pixels: usize, to: &Planes) {
        let buffers = [&training.loss_settings.raw, &training.photograph.raw, &to.luma.raw];
        r.run(&self.passes.luma, &buffers, pixels.div_ceil(GROUP));
    }

    fn multiview(
        &self,
        gpu: &Gpu,
        drawing: &Drawing,
        training: &Training,
        (rgb, neighbour): (TargetRgb, &ViewParams),
        samples: usize,
        patch: PatchSide,
    ) {
        self.pair.write(gpu, 0, &[Pair::new(&RelativePose::new(drawing.seen_view(), neighbour), neighbour)]);
        training.replace_photograph(gpu, rgb);
        let (here, there) = (&self.here, &self.there);
        let mut r = Recorder::new(gpu);
        self.luma(&mut r, training, padded_pixels(neighbour.size_px), there);
        let buffers = [
            &drawing.view.raw,
            &self.weights.raw,
            &self.pair.raw,
            &drawing.picture.image.raw,
            &here.depth.raw,
            &here.luma.raw,
            &there.depth.raw,
            &there.luma.raw,
            &training.gradient.raw,
            &self.sums.raw,
        ];
        let pass = match patch {
            PatchSide::Px3 => &self.passes.multiview,
            PatchSide::Px7 => &gpu.pass_with(cosurf_shaders::MULTIVIEW, reach_of(patch)),
        };
        r.run(pass, &buffers, samples.div_ceil(SAMPLES_AT_ONCE));
        r.submit();
    }

    fn teach(&self, gpu: &Gpu, drawing: &Drawing, training: &Training, target: &TargetSurface) {
        let pixels = target.depth.len();
        self.shown.write(gpu, 0, target.depth);
        self.shown.write(gpu, pixels, target.trust);
        self.shown.write(gpu, 2 * pixels, target.normal);
        let mut r = Recorder::new(gpu);
        let buffers = [
            &drawing.view.raw,
            &self.weights.raw,
            &drawing.picture.image.raw,
            &self.here.depth.raw,
            &self.shown.raw,
            &training.gradient.raw,
            &self.sums.raw,
        ];
        r.run(&self.passes.teacher, &buffers, drawing.tiles());
        r.submit();
    }
}

/// What the sums of the losses in [`Surface::sums`] are of.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Summed {
    tiles: usize,
    samples: usize,
    /// Number of pixels of the picture.
    pixels: f64,
    /// Whether there is a teacher.
    taught: bool,
}

impl Summed {
    /// Number of sums.
    pub(super) fn len(&self) -> usize {
        self.tiles + self.samples.div_ceil(SAMPLES_AT_ONCE)
    }

    /// The mean losses, from all sums.
    pub(super) fn losses(&self, sums: &[[f32; 4]]) -> (SurfaceLoss, TeacherLoss) {
        let (tiles, groups) = sums.split_at(self.tiles);
        let mean = |sums: &[[f32; 4]], k: usize, count: f64| {
            sums.iter().map(|sum| f64::from(sum[k])).sum::<f64>() / count.max(1.0)
        };
        let of_samples = |k| mean(groups, k, self.samples as f64);
        let surface = SurfaceLoss {
            normal: mean(tiles, 0, self.pixels),
            reprojection: of_samples(0),
            ncc: of_samples(1),
            returned: of_samples(2),
            matched: of_samples(3),
        };
        let teacher = TeacherLoss { depth: mean(tiles, 2, self.pixels), normal: mean(tiles, 3, self.pixels) };
        (surface, if self.taught { teacher } else { TeacherLoss::default() })
    }
}
