//! The passes of training and rendering that a device provides: coarse enough that each backend can use the algorithms
//! that suit it, and fine enough that a step reads as a list of passes.
//!
//! A backend owns the splats, their optimiser moments and every buffer, in the sizes that [`crate::Capacity`] gives.
//! The passes of a step, [`Backend::project`] to [`Backend::adam`], allocate nothing on the CPU; a test counts that. On
//! a GPU no buffer grows; wgpu allocates the commands and the staging memory of what is read back.

use cosurf_scene::{Camera, Splats};

/// The colours that a rendering is compared with, `[height, width, rgb]`.
#[derive(Clone, Copy, Debug)]
pub enum TargetRgb<'a> {
    /// A photograph, 0..=255.
    Bytes(&'a [u8]),
    /// Another model's rendering, 0..=1.
    Floats(&'a [f32]),
}

/// Exposure of a photograph: it shows `gain · colour + offset`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Exposure {
    /// Above 0.
    pub gain: f32,
    /// In colours of 0..=1.
    pub offset: f32,
}

impl Default for Exposure {
    /// Leaves colours unchanged.
    fn default() -> Self {
        Self { gain: 1.0, offset: 0.0 }
    }
}

/// The targets of a rendering: a photograph, or a teacher's rendering. The step is the same for both.
#[derive(Clone, Copy, Debug)]
pub struct Targets<'a> {
    /// Colours.
    pub rgb: TargetRgb<'a>,
    /// Exposure of these colours.
    pub exposure: Exposure,
    /// Colours of the neighbour that [`Backend::keep_neighbour`] kept; needed by [`SurfaceWeights::multiview`].
    pub neighbour_rgb: Option<TargetRgb<'a>>,
    /// A teacher's surface; needed by [`LossWeights::teacher`].
    pub surface: Option<TargetSurface<'a>>,
}

impl<'a> Targets<'a> {
    /// Only colours, with the default exposure.
    pub fn colors(rgb: TargetRgb<'a>) -> Self {
        Self { rgb, exposure: Exposure::default(), neighbour_rgb: None, surface: None }
    }
}

/// The surface that a rendering is compared with, laid out as in [`Rendering`].
#[derive(Clone, Copy, Debug)]
pub struct TargetSurface<'a> {
    /// `[height, width]` depth along the optical axis, world units; 0 where there is none.
    pub depth: &'a [f32],
    /// `[height, width, xyz]` blended normals in the camera frame.
    pub normal: &'a [f32],
    /// Weight of each pixel's surface in the loss, `[height, width]`, 0..=1.
    pub trust: &'a [f32],
}

/// Weights of the losses of a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LossWeights {
    /// λ of `(1 - λ) L1 + λ (1 - SSIM)`, 0..=1; 0.2 in 3DGS.
    pub ssim: f32,
    /// Weight of the mean shortest scale of the visible splats, 1 / world units.
    pub scale: f32,
    /// Weights of the surface losses; `None` leaves them out. They need [`Channels::Geometry`].
    pub surface: Option<SurfaceWeights>,
    /// Weights of the differences from a teacher's surface; `None` leaves them out. They need `surface`.
    pub teacher: Option<TeacherWeights>,
}

/// Weights of the differences from a teacher's surface (CoSurfGS, "Model Aggregation Scheme": `L_d` and `L_n`).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TeacherWeights {
    /// Weight of the absolute difference of depths, averaged over pixels; 1 / world units.
    pub depth: f32,
    /// Weight of the absolute difference of blended normals, summed over axes and averaged over pixels.
    pub normal: f32,
}

/// Weights of the surface losses (CoSurfGS, "Device-side Training Procedure"; PGSR).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfaceWeights {
    /// Weight of the single-view normal loss: the mean over pixels of the difference between blended normals and
    /// normals from depth.
    pub normal: f32,
    /// Weights of the losses that compare the view with its neighbour; `None` leaves them out. They need
    /// [`Targets::neighbour_rgb`] and a neighbour that [`Backend::keep_neighbour`] kept.
    pub multiview: Option<MultiviewWeights>,
}

/// Weights of the multi-view losses, and the pixels that they sample (PGSR).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MultiviewWeights {
    /// Weight of the reprojection error, from a pixel to the neighbour and back, averaged over sampled pixels; 1 / px.
    pub reprojection: f32,
    /// Weight of `1 - NCC²` between patches of the view and of the neighbour, averaged over sampled pixels.
    pub ncc: f32,
    /// Side of the square cells in each of which one pixel is sampled: 1, 2, 4, 8 or 16 px.
    pub cell_px: u32,
    /// Seed of the sampled pixels; a new one for each step.
    pub draw: u64,
}

/// The losses of one rendering.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Losses {
    /// Colour losses.
    pub color: PhotometricLoss,
    /// Surface losses; zero where [`LossWeights::surface`] is `None`.
    pub surface: SurfaceLoss,
    /// Differences from a teacher; zero where there is none.
    pub teacher: TeacherLoss,
}

/// Differences from a teacher's surface, without weights.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TeacherLoss {
    /// Mean over pixels of the absolute difference of depths, world units.
    pub depth: f64,
    /// Mean over pixels of the absolute difference of normals, summed over axes.
    pub normal: f64,
}

/// Surface losses, without weights.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SurfaceLoss {
    /// Mean over pixels of the absolute difference of normals, summed over axes; pixels on image edges weigh less.
    pub normal: f64,
    /// Mean over sampled pixels of `w e`, with `e` the reprojection error in px and `w = exp(-e)`; pixels with an error
    /// of 1 px or more add nothing.
    pub reprojection: f64,
    /// Mean over sampled pixels of `w (1 - NCC²)`; patches that do not match add nothing.
    pub ncc: f64,
    /// Share of the sampled pixels with a reprojection error below 1 px.
    pub returned: f64,
    /// Share of the sampled pixels whose patches match.
    pub matched: f64,
}

/// Colour losses of one rendering.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PhotometricLoss {
    /// `(1 - λ) L1 + λ (1 - SSIM)`.
    pub total: f64,
    /// Mean absolute difference between the exposed rendering and the photograph.
    pub l1: f64,
    /// Mean structural similarity, -1..=1.
    pub ssim: f64,
    /// Mean squared difference.
    pub mse: f64,
    /// ∂total/∂gain of the exposure.
    pub by_gain: f64,
    /// ∂total/∂offset of the exposure.
    pub by_offset: f64,
}

impl PhotometricLoss {
    /// Peak signal-to-noise ratio, dB.
    pub fn psnr(&self) -> f64 {
        -10.0 * self.mse.max(1e-12).log10()
    }
}

/// Channels of a rendering.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Channels {
    /// Colour and transmittance.
    Color,
    /// Colour, transmittance, normal and plane distance.
    Geometry,
}

/// Counts of one binning pass.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BinCounts {
    /// Splats that the camera sees.
    pub visible: usize,
    /// Splat–tile pairs to blend.
    pub pairs: usize,
    /// Pairs beyond the capacity, which are not blended: those of the farthest splats.
    pub dropped: usize,
}

/// Decay of Adam's first and second moment, and the term that keeps its division finite (3DGS).
pub(crate) const BETA_1: f32 = 0.9;
pub(crate) const BETA_2: f32 = 0.999;
pub(crate) const EPSILON: f32 = 1e-15;

/// Learning rates of one Adam step. Bias corrections are set by [`AdamRates::at_step`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AdamRates {
    /// Of means, world units.
    pub mean: f32,
    /// Of quaternions.
    pub quat: f32,
    /// Of log-scales.
    pub log_scale: f32,
    /// Of opacity logits.
    pub opacity: f32,
    /// Of the constant colour term.
    pub sh_dc: f32,
    /// Of the other SH coefficients.
    pub sh_rest: f32,
    /// `1 / (1 - β₁^step)`.
    pub first_correction: f32,
    /// `1 / (1 - β₂^step)`.
    pub second_correction: f32,
}

impl AdamRates {
    /// Sets the bias corrections `1 / (1 - β^step)` for the `step`-th update, counted from 1.
    pub fn at_step(self, step: u32) -> Self {
        let correction = |beta: f32| (1.0 / (1.0 - f64::from(beta).powf(f64::from(step.max(1))))) as f32;
        Self { first_correction: correction(BETA_1), second_correction: correction(BETA_2), ..self }
    }
}

/// A picture rendered from splats. All arrays are row by row.
#[derive(Clone, Debug, PartialEq)]
pub struct Rendering {
    /// Width and height.
    pub size_px: [u32; 2],
    /// `[h, w, rgb]`, 0 and up; the background is black.
    pub rgb: Vec<f32>,
    /// `[h, w]`, 0..=1.
    pub alpha: Vec<f32>,
    /// `[h, w]` unbiased depth along the optical axis, world units (PGSR: blended plane distance divided by the
    /// component of the blended normal along the ray); 0 where there is no surface.
    pub depth: Vec<f32>,
    /// `[h, w, xyz]` alpha-blended normals in the camera frame, facing the camera, not normalised.
    pub normal: Vec<f32>,
}

impl Rendering {
    /// Size in memory, bytes.
    pub fn bytes(&self) -> usize {
        let Self { rgb, alpha, depth, normal, .. } = self;
        let values = [rgb, alpha, depth, normal].map(|values| size_of_val(&values[..]));
        size_of::<Self>() + values.iter().sum::<usize>()
    }
}

/// Shapes and statistics from which refinement decides; entry `i` is splat `i`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Shapes {
    /// World units.
    pub means: Vec<[f32; 3]>,
    /// wxyz.
    pub quats: Vec<[f32; 4]>,
    /// ln world units.
    pub log_scales: Vec<[f32; 3]>,
    /// Opacities before the logistic function.
    pub opacity_logits: Vec<f32>,
    /// Mean over views of the norm of ∂L/∂mean on the screen, in units of half the picture; 0 if no view saw the splat.
    pub screen_gradients: Vec<f32>,
    /// The same, but of the sums of absolute values over pixels (AbsGS).
    pub absolute_gradients: Vec<f32>,
    /// Views that saw the splat since the last refinement.
    pub views: Vec<f32>,
}

/// Contributions of the splats to the scored pictures; entry `i` is splat `i`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scores {
    /// Sum of squared blend weights `(α T)²` over all pixels. Up to a factor of colour it is the squared error of the
    /// pictures without the splat.
    pub squared_weights: Vec<f32>,
    /// Pixels that the splat was blended into.
    pub hits: Vec<f32>,
    /// Views that observe the splat: it was blended into one of their pixels while transmittance was above one half.
    pub observers: Vec<f32>,
}

/// A new splat: a copy of `parent` except for the fields here; its moments are zero.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Birth {
    /// Index of the parent before the edit.
    pub parent: u32,
    /// World units.
    pub mean: [f32; 3],
    /// ln world units.
    pub log_scale: [f32; 3],
    /// Opacity before the logistic function.
    pub opacity_logit: f32,
}

/// Splats to add and to remove. New splats take the places of removed ones first, then go to the end; places that
/// remain empty are filled with splats from the end.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Edit {
    /// New splats, in order.
    pub births: Vec<Birth>,
    /// Indices of splats to remove, ascending. A removed splat may be a parent.
    pub deaths: Vec<u32>,
}

/// A device that trains and renders. Passes are called in the order of their declaration; each reads what the passes
/// before it left in the backend.
pub trait Backend {
    /// Name of the device for people: `cpu avx512 × 2`.
    fn device(&self) -> String;

    /// Why the device was lost, or `None`. The results of a lost device are not valid.
    fn lost(&self) -> Option<String> {
        None
    }

    /// Number of splats.
    fn len(&self) -> usize;

    /// Whether there are no splats.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Largest number of splats.
    fn capacity(&self) -> usize;

    /// Replaces all splats; moments and statistics become zero. Panics beyond the capacity.
    fn load(&mut self, splats: &Splats);

    /// The splats as they are now.
    fn splats(&self) -> Splats;

    /// Projects all splats: 2D Gaussians, colours (SH up to `sh_degree`) and planes for a camera.
    fn project(&mut self, camera: &Camera, sh_degree: u32);

    /// Makes the sorted splat list of each tile.
    fn bin(&mut self) -> BinCounts;

    /// Blends the picture.
    fn rasterize(&mut self, channels: Channels);

    /// Keeps camera and depth of the picture last blended (with [`Channels::Geometry`]) as the neighbour of the
    /// following pictures.
    fn keep_neighbour(&mut self);

    /// Computes the losses of the picture and their gradient with respect to every pixel.
    fn losses(&mut self, targets: &Targets, weights: &LossWeights) -> Losses;

    /// Computes the gradients of the projected splats.
    fn rasterize_backward(&mut self);

    /// Computes the gradients of the parameters, and adds to the densification statistics.
    fn project_backward(&mut self);

    /// The gradients of the last backward pass, each in the place of its parameter; zero for splats that the camera did
    /// not see. For tests and comparisons of backends.
    fn gradients(&self) -> Splats;

    /// One optimiser step on all splats; splats that the camera did not see have gradient zero.
    fn adam(&mut self, rates: &AdamRates);

    /// The picture last blended. Depth and normal are empty if only colour was blended.
    fn rendering(&self) -> Rendering;

    /// The shapes and statistics for refinement; resets the statistics to zero.
    fn take_shapes(&mut self) -> Shapes;

    /// Resets all scores to zero.
    fn clear_scores(&mut self);

    /// Adds each splat's contribution to the picture last blended to its scores.
    fn score(&mut self);

    /// The scores since they were cleared.
    fn scores(&self) -> Scores;

    /// Adds and removes splats. Panics beyond the capacity.
    fn edit(&mut self, edit: &Edit);

    /// Lowers every opacity to at most `opacity` and resets the moments of opacities to zero.
    fn cap_opacity(&mut self, opacity: f32);

    /// Visits parameters, moments and statistics in a fixed order, in pieces. Together with [`Backend::import`] this is
    /// a checkpoint: a training resumed on the same backend ends with the same bits. Stops at the first error.
    fn export<E>(&self, visit: impl FnMut(&[f32]) -> Result<(), E>) -> Result<(), E>
    where
        Self: Sized;

    /// Restores `len` splats from what [`Backend::export`] visited: `fill` is called with the same pieces.
    fn import<E>(&mut self, len: usize, fill: impl FnMut(&mut [f32]) -> Result<(), E>) -> Result<(), E>
    where
        Self: Sized;
}
