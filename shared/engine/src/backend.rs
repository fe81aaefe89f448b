//! What training and rendering ask of a device: the passes, coarse enough that each backend does them
//! its own best way, and fine enough that a step reads as its list of passes.
//!
//! A backend owns the splats, their optimiser moments and every buffer; nothing here allocates after
//! [`Backend::load`] beyond the capacities that [`crate::Budget`] gave it.

use cosurf_scene::{Camera, Splats};

/// Colours that a rendering should have, `[height, width, rgb]`.
#[derive(Clone, Copy, Debug)]
pub enum TargetRgb<'a> {
    /// A photograph, 0..=255.
    Bytes(&'a [u8]),
    /// Another model's rendering, 0..=1.
    Floats(&'a [f32]),
}

/// How a photograph was exposed: it shows `gain · colour + offset`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Exposure {
    /// Above 0.
    pub gain: f32,
    /// In colours of 0..=1.
    pub offset: f32,
}

impl Default for Exposure {
    /// Colours as they are.
    fn default() -> Self {
        Self { gain: 1.0, offset: 0.0 }
    }
}

/// What a rendering should look like: a photograph, or a teacher's rendering. Both are the same step.
#[derive(Clone, Copy, Debug)]
pub struct Targets<'a> {
    /// Colours.
    pub rgb: TargetRgb<'a>,
    /// How they were exposed.
    pub exposure: Exposure,
    /// Colours of the neighbour that [`Backend::keep_neighbour`] kept, for the multi-view losses.
    pub neighbour_rgb: Option<TargetRgb<'a>>,
    /// The surface as a teacher sees it; needed by [`LossWeights::teacher`].
    pub surface: Option<TargetSurface<'a>>,
}

impl<'a> Targets<'a> {
    /// Colours alone.
    pub fn colors(rgb: TargetRgb<'a>) -> Self {
        Self { rgb, exposure: Exposure::default(), neighbour_rgb: None, surface: None }
    }
}

/// A surface that a rendering should show, as in [`Rendering`].
#[derive(Clone, Copy, Debug)]
pub struct TargetSurface<'a> {
    /// `[height, width]` depth along the optical axis, world units; 0 where there is none.
    pub depth: &'a [f32],
    /// `[height, width, xyz]` blended normals in the camera frame.
    pub normal: &'a [f32],
    /// How far each pixel's surface is to be believed, `[height, width]`, 0..=1.
    pub trust: &'a [f32],
}

/// How much each loss counts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LossWeights {
    /// λ of `(1 - λ) L1 + λ (1 - SSIM)`, 0..=1; 0.2 in 3DGS.
    pub ssim: f32,
    /// Of the mean shortest scale of the visible splats, 1 / world units.
    pub scale: f32,
    /// Of the surface's losses; `None` leaves them out. They need [`Channels::Geometry`].
    pub surface: Option<SurfaceWeights>,
    /// Of the differences from a teacher's surface; `None` leaves them out. They need `surface`.
    pub teacher: Option<TeacherWeights>,
}

/// How much a teacher's surface counts (CoSurfGS, "Model Aggregation Scheme": `L_d` and `L_n`).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TeacherWeights {
    /// Of the absolute difference of depths, a mean over pixels; 1 / world units.
    pub depth: f32,
    /// Of the absolute difference of blended normals, summed over axes, a mean over pixels.
    pub normal: f32,
}

/// How much each loss of the surface counts (CoSurfGS, "Device-side Training Procedure"; PGSR).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfaceWeights {
    /// Of the disagreement between blended normals and the normals of the depth, a mean over pixels.
    pub normal: f32,
    /// Of the losses that compare the view with its neighbour; `None` leaves them out. They need
    /// [`Targets::neighbour_rgb`] and a neighbour that [`Backend::keep_neighbour`] kept.
    pub multiview: Option<MultiviewWeights>,
}

/// How much each multi-view loss counts, and on which pixels (PGSR).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MultiviewWeights {
    /// Of the error of going to the neighbour and back, a mean over sampled pixels; 1 / px.
    pub reprojection: f32,
    /// Of `1 - NCC²` between patches here and at the neighbour, a mean over sampled pixels.
    pub ncc: f32,
    /// One pixel is sampled in each square of this side: 1, 2, 4, 8 or 16 px.
    pub cell_px: u32,
    /// Which pixels are sampled; a new number for each step.
    pub draw: u64,
}

/// The losses of one rendering.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Losses {
    /// Of the colours.
    pub color: PhotometricLoss,
    /// Of the surface; zero where it was not asked for.
    pub surface: SurfaceLoss,
    /// Of the differences from a teacher; zero where there is none.
    pub teacher: TeacherLoss,
}

/// The differences from a teacher's surface, not weighted.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TeacherLoss {
    /// Mean over pixels of the absolute difference of depths, world units.
    pub depth: f64,
    /// Mean over pixels of the absolute difference of normals, summed over axes.
    pub normal: f64,
}

/// The losses of the surface, not weighted.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SurfaceLoss {
    /// Mean over pixels of the absolute difference of normals, summed over axes, edges counting less.
    pub normal: f64,
    /// Mean over sampled pixels of `w e`, with `e` in px the way to the neighbour and back and `w = exp(-e)`;
    /// pixels that do not come back to within 1 px add nothing.
    pub reprojection: f64,
    /// Mean over sampled pixels of `w (1 - NCC²)`; patches that do not match add nothing.
    pub ncc: f64,
    /// Share of the sampled pixels that came back.
    pub returned: f64,
    /// Share of the sampled pixels whose patches match.
    pub matched: f64,
}

/// The colour loss of one rendering.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PhotometricLoss {
    /// `(1 - λ) L1 + λ (1 - SSIM)`.
    pub total: f64,
    /// Mean absolute difference from the exposed picture.
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

/// Which channels a rendering has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Channels {
    /// Colour and transmittance.
    Color,
    /// Colour, transmittance, normal and plane distance.
    Geometry,
}

/// What binning found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BinCounts {
    /// Splats that the camera sees.
    pub visible: usize,
    /// Splat–tile pairs to blend.
    pub pairs: usize,
    /// Pairs for which there was no room: those of the farthest splats.
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
    /// Fills in the bias corrections `1 / (1 - β^step)` for the `step`-th update, counted from 1.
    pub fn at_step(self, step: u32) -> Self {
        let correction = |beta: f32| (1.0 / (1.0 - f64::from(beta).powf(f64::from(step.max(1))))) as f32;
        Self { first_correction: correction(BETA_1), second_correction: correction(BETA_2), ..self }
    }
}

/// A picture as the splats show it. All arrays row by row.
#[derive(Clone, Debug, PartialEq)]
pub struct Rendering {
    /// Width and height.
    pub size_px: [u32; 2],
    /// `[h, w, rgb]`, 0 and up; the background is black.
    pub rgb: Vec<f32>,
    /// `[h, w]`, 0..=1.
    pub alpha: Vec<f32>,
    /// `[h, w]` unbiased depth along the optical axis, world units (PGSR: blended plane distance over the
    /// blended normal's share along the ray); 0 where there is no surface.
    pub depth: Vec<f32>,
    /// `[h, w, xyz]` alpha-blended normals in the camera frame, facing the camera, not normalised.
    pub normal: Vec<f32>,
}

impl Rendering {
    /// What it takes in memory.
    pub fn bytes(&self) -> usize {
        let Self { rgb, alpha, depth, normal, .. } = self;
        let values = [rgb, alpha, depth, normal].map(|values| size_of_val(&values[..]));
        size_of::<Self>() + values.iter().sum::<usize>()
    }
}

/// Shapes and statistics that refinement decides by; entry `i` is splat `i`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Shapes {
    /// World units.
    pub means: Vec<[f32; 3]>,
    /// wxyz.
    pub quats: Vec<[f32; 4]>,
    /// ln world units.
    pub log_scales: Vec<[f32; 3]>,
    /// Before the logistic function.
    pub opacity_logits: Vec<f32>,
    /// Mean over views of the norm of ∂L/∂mean on the screen, in units of half the picture; 0 if unseen.
    pub screen_gradients: Vec<f32>,
    /// The same with the absolute value taken in each pixel before the sum (AbsGS).
    pub absolute_gradients: Vec<f32>,
    /// Views that saw the splat since the last refinement.
    pub views: Vec<f32>,
}

/// What splats gave to the pictures that were scored; entry `i` is splat `i`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scores {
    /// Sum of squared blend weights `(α T)²` over all pixels: but for the colours, the squared error that the
    /// pictures would have without the splat.
    pub squared_weights: Vec<f32>,
    /// Pixels that the splat was blended into.
    pub hits: Vec<f32>,
    /// Views with a pixel that the splat was blended into while more than half of the light came through.
    pub observers: Vec<f32>,
}

/// A new splat: a copy of `parent` but for what is named here; its moments are zero.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Birth {
    /// Index before the edit.
    pub parent: u32,
    /// World units.
    pub mean: [f32; 3],
    /// ln world units.
    pub log_scale: [f32; 3],
    /// Before the logistic function.
    pub opacity_logit: f32,
}

/// One refinement: births go to the places of the dead first, then to the end; places that are still
/// empty are filled from the end.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Edit {
    /// New splats, in order.
    pub births: Vec<Birth>,
    /// Indices of splats to remove, ascending. A dead splat may be a parent.
    pub deaths: Vec<u32>,
}

/// A device that trains and renders. Passes are called in the order of their declaration; each uses what
/// the ones before it left in the backend.
pub trait Backend {
    /// What computes, for people: `cpu avx512 × 2`.
    fn device(&self) -> String;

    /// Why nothing that this backend says is to be believed any more: its device was lost.
    fn lost(&self) -> Option<String> {
        None
    }

    /// Splats now.
    fn len(&self) -> usize;

    /// Whether there are no splats.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Most splats that fit.
    fn capacity(&self) -> usize;

    /// Replaces all splats; moments and statistics become zero. Panics beyond the capacity.
    fn load(&mut self, splats: &Splats);

    /// The splats as they are now.
    fn splats(&self) -> Splats;

    /// 2D Gaussians, colours (up to `sh_degree`) and planes for a camera.
    fn project(&mut self, camera: &Camera, sh_degree: u32);

    /// Sorted tile lists.
    fn bin(&mut self) -> BinCounts;

    /// Blends the picture.
    fn rasterize(&mut self, channels: Channels);

    /// Keeps camera and depth of the picture last blended (with [`Channels::Geometry`]) as the neighbour of
    /// the pictures that follow.
    fn keep_neighbour(&mut self);

    /// The losses of the picture, and their gradient with respect to every pixel.
    fn losses(&mut self, targets: &Targets, weights: &LossWeights) -> Losses;

    /// Gradients of the projected splats.
    fn rasterize_backward(&mut self);

    /// Gradients of the parameters, and the statistics of densification.
    fn project_backward(&mut self);

    /// The gradients of the last backward pass, each in the place of its parameter; zero for splats that the
    /// camera did not see. For comparing backends and checking them.
    fn gradients(&self) -> Splats;

    /// One optimiser step on all splats; those that the camera did not see have gradient zero.
    fn adam(&mut self, rates: &AdamRates);

    /// The picture last blended. Depth and normal are empty if only colour was blended.
    fn rendering(&self) -> Rendering;

    /// What refinement decides by; statistics begin anew.
    fn take_shapes(&mut self) -> Shapes;

    /// Scores begin anew, all zero.
    fn clear_scores(&mut self);

    /// Adds what each splat gave to the picture last blended to its scores.
    fn score(&mut self);

    /// The scores since they were cleared.
    fn scores(&self) -> Scores;

    /// Adds and removes splats. Panics beyond the capacity.
    fn edit(&mut self, edit: &Edit);

    /// Lowers every opacity to at most `opacity` and forgets the opacities' moments.
    fn cap_opacity(&mut self, opacity: f32);

    /// Visits parameters, moments and statistics in a fixed order, in pieces; with [`Backend::import`] this
    /// is a checkpoint that continues to the same bits on the same backend. Stops at the first error.
    fn export<E>(&self, visit: impl FnMut(&[f32]) -> Result<(), E>) -> Result<(), E>
    where
        Self: Sized;

    /// Restores `len` splats from what [`Backend::export`] visited: `fill` is called with the same pieces.
    fn import<E>(&mut self, len: usize, fill: impl FnMut(&mut [f32]) -> Result<(), E>) -> Result<(), E>
    where
        Self: Sized;
}
