//! The passes of training, and their buffers: colour loss, backward passes, Adam, scores.

use super::buffer::Buffer;
use super::context::{Gpu, GpuError};
use super::draw::Drawing;
use super::model::Model;
use super::pass::{Constants, Pass};
use super::recorder::Recorder;
use super::sort::GROUP;
use super::structs::{BackwardWeights, LossSettings, Rates};
use crate::backend::{Exposure, PhotometricLoss, TargetRgb};
use crate::budget::PARTIALS;
use crate::layout::planes::PLANES_GEOMETRY;
use crate::layout::rows::{GRADIENT_ROWS, RECORD_LEN, SCORE_ROWS, SH, STAT_ROWS, sh_rows};
use crate::layout::tiles::padded_pixels;

/// The record of a splat–tile pair.
type Record = [f32; RECORD_LEN];
/// Number of loss sums for each channel of each tile.
pub(super) const SUMS: usize = 8;

#[derive(Debug)]
struct Passes {
    ssim: Pass,
    photometric_gradient: Pass,
    loss_total: Pass,
    rasterize_backward: Pass,
    project_backward: Pass,
    adam: Pass,
    score: Pass,
    score_collect: Pass,
}

/// The passes of training, and the buffers that only training needs. The splats are in [`Model`]. The view, the
/// splat–tile pairs and the rendered picture are in [`Drawing`].
#[derive(Debug)]
pub(super) struct Training {
    passes: Passes,
    pub(super) loss_settings: Buffer<LossSettings>,
    backward_weights: Buffer<BackwardWeights>,
    rates: Buffer<Rates>,
    pub(super) photograph: Buffer<u32>,
    partials: Buffer<f32>,
    sums: Buffer<[f32; SUMS]>,
    pub(super) totals: Buffer<[f32; SUMS]>,
    /// Gradient of the loss with respect to the picture, in the layout of the picture.
    pub(super) gradient: Buffer<f32>,
    /// Edits keep the numbers that they move here.
    pub(super) records: Buffer<Record>,
    /// Gradients with respect to the shapes and colours of the splats, in rows as in a [`Model`]. Statistics and scores
    /// have such rows as well.
    pub(super) gradients: Buffer<f32>,
    pub(super) stats: Buffer<f32>,
    /// Edits list their moves here.
    pub(super) scores: Buffer<f32>,
    /// First and second moments of the shapes, then first and second moments of the spherical harmonics.
    pub(super) moments: [Buffer<f32>; 4],
}

impl Training {
    pub(super) fn new(gpu: &Gpu, model: &Model, pairs: usize, size_px: [u32; 2]) -> Result<Self, GpuError> {
        let (pixels, tiles) = (padded_pixels(size_px), padded_pixels(size_px) / GROUP);
        let rows = |label, rows: usize| Buffer::storage(gpu, label, rows * model.stride);
        let sh_rows = sh_rows(model.sh_degree);
        let zeroed = bytemuck::Zeroable::zeroed;
        Ok(Self {
            passes: Passes {
                ssim: gpu.pass(cosurf_shaders::SSIM),
                photometric_gradient: gpu.pass(cosurf_shaders::PHOTOMETRIC_GRADIENT),
                loss_total: gpu.pass(cosurf_shaders::LOSS_TOTAL),
                rasterize_backward: match gpu.subgroups() {
                    Some(size) => gpu.pass_with(cosurf_shaders::RASTERIZE_BACKWARD_BY_PIXEL, size),
                    None => gpu.pass_with(cosurf_shaders::RASTERIZE_BACKWARD, pipelined(gpu)),
                },
                project_backward: gpu.pass(cosurf_shaders::PROJECT_BACKWARD),
                adam: gpu.pass(cosurf_shaders::ADAM),
                score: gpu.pass_with(cosurf_shaders::SCORE, pipelined(gpu)),
                score_collect: gpu.pass(cosurf_shaders::SCORE_COLLECT),
            },
            loss_settings: Buffer::uniform(gpu, "loss settings", zeroed()),
            backward_weights: Buffer::uniform(gpu, "backward weights", BackwardWeights { scale: 0.0 }),
            rates: Buffer::uniform(gpu, "rates", bytemuck::Zeroable::zeroed()),
            photograph: Buffer::storage(gpu, "photograph", 3 * pixels)?,
            partials: Buffer::storage(gpu, "partials", PARTIALS * pixels)?,
            sums: Buffer::storage(gpu, "loss sums", 3 * tiles)?,
            totals: Buffer::storage(gpu, "loss totals", 1)?,
            gradient: Buffer::storage(gpu, "gradient of the picture", PLANES_GEOMETRY * pixels)?,
            // An edit needs room for one row.
            records: Buffer::storage(gpu, "records", pairs.max(model.stride.div_ceil(RECORD_LEN)))?,
            gradients: rows("gradients", GRADIENT_ROWS)?,
            stats: rows("statistics", STAT_ROWS)?,
            scores: rows("scores", SCORE_ROWS)?,
            moments: [
                rows("first moments of shapes", SH)?,
                rows("second moments of shapes", SH)?,
                rows("first moments of spherical harmonics", sh_rows)?,
                rows("second moments of spherical harmonics", sh_rows)?,
            ],
        })
    }

    /// Sets moments, statistics, scores and gradients to zero.
    pub(super) fn reset(&self, gpu: &Gpu) {
        let mut r = Recorder::new(gpu);
        self.moments.iter().for_each(|moments| r.clear(&moments.raw));
        [&self.stats, &self.scores, &self.gradients].into_iter().for_each(|buffer| r.clear(&buffer.raw));
        r.submit();
    }

    /// Computes the sums of the colour loss, which [`loss`] takes, and its gradient with respect to every pixel.
    pub(super) fn photometric(
        &self,
        gpu: &Gpu,
        drawing: &Drawing,
        rgb: TargetRgb,
        exposure: Exposure,
        ssim_weight: f32,
    ) {
        let size_px = drawing.seen_view().size_px;
        let values = 3.0 * size_px[0] as f32 * size_px[1] as f32;
        let settings = LossSettings {
            gain: exposure.gain,
            offset: exposure.offset,
            l1_weight: (1.0 - ssim_weight) / values,
            ssim_weight: ssim_weight / values,
            is_floats: is_floats(rgb),
            unused_1: 0,
            unused_2: 0,
            unused_3: 0,
        };
        self.loss_settings.write(gpu, 0, &[settings]);
        self.upload(gpu, rgb);
        let (view, settings) = (&drawing.view.raw, &self.loss_settings.raw);
        let (image, photograph) = (&drawing.picture.image.raw, &self.photograph.raw);
        let (partials, sums) = (&self.partials.raw, &self.sums.raw);
        let jobs = 3 * drawing.tiles();
        let mut r = Recorder::new(gpu);
        r.run(&self.passes.ssim, &[view, settings, image, photograph, partials, sums], jobs);
        let buffers = [view, settings, image, photograph, partials, sums, &self.gradient.raw];
        r.run(&self.passes.photometric_gradient, &buffers, jobs);
        r.run(&self.passes.loss_total, &[view, sums, &self.totals.raw], 1);
        r.submit();
    }

    /// Replaces the uploaded photograph by that of the neighbouring view, for the pass `luma`. Sets all loss settings
    /// to zero, except the one that says how the photograph is stored.
    pub(super) fn replace_photograph(&self, gpu: &Gpu, rgb: TargetRgb) {
        let settings = LossSettings { is_floats: is_floats(rgb), ..bytemuck::Zeroable::zeroed() };
        self.loss_settings.write(gpu, 0, &[settings]);
        self.upload(gpu, rgb);
    }

    fn upload(&self, gpu: &Gpu, rgb: TargetRgb) {
        match rgb {
            TargetRgb::Floats(values) => self.photograph.write_bytes(gpu, 0, bytemuck::cast_slice(values)),
            TargetRgb::Bytes(bytes) => self.photograph.write_bytes(gpu, 0, bytes),
        }
    }

    /// Computes the gradients with respect to the projected splats, as one record for each splat–tile pair.
    pub(super) fn rasterize_backward(&self, gpu: &Gpu, drawing: &Drawing) {
        let mut r = Recorder::new(gpu);
        r.run(
            &self.passes.rasterize_backward,
            &[
                &drawing.view.raw,
                &drawing.seen.projected.raw,
                drawing.pairs.sorted_slots(),
                &drawing.pairs.id_of_slot.raw,
                &drawing.picture.ranges.raw,
                &drawing.picture.blended.raw,
                &drawing.picture.image.raw,
                &self.gradient.raw,
                &self.records.raw,
            ],
            drawing.tiles(),
        );
        r.submit();
    }

    /// Computes the gradients with respect to the parameters, and adds to the densification statistics.
    pub(super) fn project_backward(&self, gpu: &Gpu, model: &Model, drawing: &Drawing, scale_weight: f32) {
        self.backward_weights.write(gpu, 0, &[BackwardWeights { scale: scale_weight }]);
        let mut r = Recorder::new(gpu);
        r.run(
            &self.passes.project_backward,
            &[
                &drawing.view.raw,
                &self.backward_weights.raw,
                &model.shape.raw,
                &model.sh.raw,
                &drawing.seen.projected.raw,
                &drawing.seen.slots.raw,
                &self.records.raw,
                &self.gradients.raw,
                &self.stats.raw,
            ],
            model.len.div_ceil(GROUP),
        );
        r.submit();
    }

    /// Runs one step of the optimiser.
    pub(super) fn adam(&self, gpu: &Gpu, model: &Model, drawing: &Drawing, rates: Rates) {
        self.rates.write(gpu, 0, &[rates]);
        let [shape_first, shape_second, sh_first, sh_second] = &self.moments;
        let mut r = Recorder::new(gpu);
        r.run(
            &self.passes.adam,
            &[
                &drawing.view.raw,
                &self.rates.raw,
                &model.shape.raw,
                &model.sh.raw,
                &shape_first.raw,
                &shape_second.raw,
                &sh_first.raw,
                &sh_second.raw,
                &self.gradients.raw,
            ],
            model.len.div_ceil(GROUP),
        );
        r.submit();
    }

    /// Adds each splat's contribution to the picture to its scores.
    pub(super) fn score(&self, gpu: &Gpu, model: &Model, drawing: &Drawing) {
        let (view, projected) = (&drawing.view.raw, &drawing.seen.projected.raw);
        let mut r = Recorder::new(gpu);
        r.run(
            &self.passes.score,
            &[
                view,
                projected,
                drawing.pairs.sorted_slots(),
                &drawing.pairs.id_of_slot.raw,
                &drawing.picture.ranges.raw,
                &drawing.picture.blended.raw,
                &self.records.raw,
            ],
            drawing.tiles(),
        );
        let buffers = [view, &drawing.seen.slots.raw, projected, &self.records.raw, &self.scores.raw];
        r.run(&self.passes.score_collect, &buffers, model.len.div_ceil(GROUP));
        r.submit();
    }
}

/// Values of the `override` constants that divide the work of a tile: for graphics cards, then for software drivers. In
/// a software driver every invocation takes time at every barrier, so few pairs at a time and long steps are faster.
pub(super) const PIPELINED: [Constants; 2] =
    [&[("PAIRS_AT_ONCE", 64.0), ("CHUNK", 4.0)], &[("PAIRS_AT_ONCE", 16.0), ("CHUNK", 16.0)]];

fn pipelined(gpu: &Gpu) -> Constants {
    PIPELINED[usize::from(gpu.adapter().is_software)]
}

fn is_floats(rgb: TargetRgb) -> u32 {
    u32::from(matches!(rgb, TargetRgb::Floats(_)))
}

/// The colour loss, from sums over all values of a picture. `totals` has the order in which the shaders write them.
pub(super) fn loss(totals: [f32; SUMS], size_px: [u32; 2], ssim_weight: f32) -> PhotometricLoss {
    let values = 3.0 * size_px[0] as f32 * size_px[1] as f32;
    let [ssim, squares, l1, signs, signed_x, ..] = totals.map(|total| f64::from(total) / f64::from(values));
    let weight = f64::from(ssim_weight);
    PhotometricLoss {
        total: (1.0 - weight) * l1 + weight * (1.0 - ssim),
        l1,
        ssim,
        mse: squares,
        by_gain: (1.0 - weight) * signed_x,
        by_offset: (1.0 - weight) * signs,
    }
}
