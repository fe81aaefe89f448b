//! The passes of training and rendering that a device provides. They are coarse enough that each backend can use the
//! algorithms that suit it, and fine enough that a training step reads as a list of passes.
//!
//! A backend owns the splats, their optimiser moments and every buffer, in the sizes that [`crate::Capacity`] gives. On
//! the CPU the passes of a step, [`Backend::project`] to [`Backend::adam`], allocate nothing; a test counts the
//! allocations. On a GPU no buffer grows, but wgpu allocates memory for commands and for results that are read back.

use cosurf_scene::picture::MASKED;
use cosurf_scene::{Camera, Splats};

/// The colours that a rendering is compared with, `[height, width, rgb]`.
#[derive(Clone, Copy, Debug)]
pub enum TargetRgb<'a> {
    /// A photograph, 0..=255. Pixels of the colour [`MASKED`] add nothing to any loss, and get no gradient.
    Bytes(&'a [u8]),
    /// Another model's rendering, 0 and up.
    Floats(&'a [f32]),
}

impl TargetRgb<'_> {
    /// Whether any pixel is masked.
    pub(crate) fn is_masked(&self) -> bool {
        matches!(self, Self::Bytes(rgb) if rgb.chunks_exact(3).any(|pixel| pixel == MASKED))
    }

    /// The columns of the masked pixels of picture row `y`.
    pub(crate) fn masked_in(&self, y: usize, width: usize) -> impl Iterator<Item = usize> {
        let row = match self {
            Self::Bytes(rgb) => &rgb[3 * y * width..3 * (y + 1) * width],
            Self::Floats(_) => &[],
        };
        row.chunks_exact(3).enumerate().filter(|(_, pixel)| *pixel == MASKED).map(|(x, _)| x)
    }
}

/// Exposure of a photograph. A colour of the scene appears in the photograph as `gain · colour + offset`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Exposure {
    /// Factor on colours, above 0.
    pub gain: f32,
    /// Added to colours, which are 0..=1.
    pub offset: f32,
}

impl Default for Exposure {
    /// Leaves colours unchanged.
    fn default() -> Self {
        Self { gain: 1.0, offset: 0.0 }
    }
}

/// What a rendering is compared with: a photograph, or the rendering of a teacher (a model from which this one is
/// distilled). The passes are the same for both.
#[derive(Clone, Copy, Debug)]
pub struct Targets<'a> {
    /// Colours of the view.
    pub rgb: TargetRgb<'a>,
    /// Exposure of the photograph in `rgb`.
    pub exposure: Exposure,
    /// Colours of the neighbouring view that [`Backend::keep_neighbour`] kept; needed by [`SurfaceWeights::multiview`].
    pub neighbour_rgb: Option<TargetRgb<'a>>,
    /// Surface that the teacher rendered; needed by [`LossWeights::teacher`].
    pub surface: Option<TargetSurface<'a>>,
}

impl<'a> Targets<'a> {
    /// Targets with colours only, and with the default exposure.
    pub fn colors(rgb: TargetRgb<'a>) -> Self {
        Self { rgb, exposure: Exposure::default(), neighbour_rgb: None, surface: None }
    }
}

/// The surface that a rendering is compared with, laid out as in [`Rendering`].
#[derive(Clone, Copy, Debug)]
pub struct TargetSurface<'a> {
    /// `[height, width]` depth along the optical axis, world units; 0 where there is no surface.
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
    /// Weights of the surface losses; `None` leaves these losses out. They need [`Channels::Geometry`].
    pub surface: Option<SurfaceWeights>,
    /// Weights of the differences from a teacher's surface; `None` leaves these losses out. They need `surface` here
    /// and [`Targets::surface`].
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
    /// Weights of the losses that compare the view with a neighbouring view; `None` leaves these losses out. They need
    /// [`Targets::neighbour_rgb`] and a neighbouring view that [`Backend::keep_neighbour`] kept.
    pub multiview: Option<MultiviewWeights>,
}

/// Side of the patches of a view that are compared with patches of the neighbouring view.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum PatchSide {
    /// 3 px: fast, and follows fine relief.
    #[default]
    Px3,
    /// 7 px, as in PGSR.
    Px7,
}

/// Weights of the multi-view losses, and the pixels that they sample (PGSR).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MultiviewWeights {
    /// Weight of the reprojection error, averaged over sampled pixels; 1 / px. The error is the distance, px, between a
    /// pixel and the place where it arrives after projection into the neighbouring view and back.
    pub reprojection: f32,
    /// Weight of `1 - NCC²` between patches of the view and of the neighbouring view, averaged over sampled pixels. NCC
    /// is the normalised cross-correlation of luma.
    pub ncc: f32,
    /// Side of the square cells in which pixels are sampled, one in each: 1, 2, 4, 8 or 16 px.
    pub cell_px: u32,
    /// Side of the patches.
    pub patch: PatchSide,
    /// Seed of the sampled pixels. Each step uses another.
    pub draw: u64,
}

/// The losses of one rendering.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Losses {
    /// Colour losses.
    pub color: PhotometricLoss,
    /// Surface losses; zero if [`LossWeights::surface`] is `None`.
    pub surface: SurfaceLoss,
    /// Differences from a teacher; zero if [`LossWeights::teacher`] is `None`.
    pub teacher: TeacherLoss,
}

/// Differences from a teacher's surface, before [`TeacherWeights`] are applied. Each pixel counts with its
/// [`TargetSurface::trust`].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TeacherLoss {
    /// Mean over pixels of the absolute difference of depths, world units. Pixels where the rendering or the teacher
    /// has no depth add nothing.
    pub depth: f64,
    /// Mean over pixels of the absolute difference of normals, summed over axes.
    pub normal: f64,
}

/// Surface losses, before [`SurfaceWeights`] are applied.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SurfaceLoss {
    /// Mean over pixels of the absolute difference between blended normals and normals from depth, summed over axes.
    /// Pixels on edges in the photograph weigh less. Pixels without a normal from depth add nothing.
    pub normal: f64,
    /// Mean over sampled pixels of `w e`, with the reprojection error `e` in px and `w = exp(-e)`. Pixels without such
    /// an error, or with one of 1 px or more, add nothing.
    pub reprojection: f64,
    /// Mean over sampled pixels of `w (1 - NCC²)`, with `w = exp(-e)` for the reprojection error `e` in px. Pixels with
    /// an error of 1 px or more, or with patches that do not match, add nothing.
    pub ncc: f64,
    /// Share of the sampled pixels with a reprojection error below 1 px.
    pub returned: f64,
    /// Share of the sampled pixels with a reprojection error below 1 px and patches that match.
    pub matched: f64,
}

/// Colour losses of one rendering.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PhotometricLoss {
    /// `(1 - λ) L1 + λ (1 - SSIM)`, with the λ of [`LossWeights::ssim`].
    pub total: f64,
    /// Mean absolute difference between the rendering, with the exposure applied, and the photograph.
    pub l1: f64,
    /// Mean structural similarity, -1..=1.
    pub ssim: f64,
    /// Mean squared difference between the rendering, without the exposure, and the photograph.
    pub mse: f64,
    /// ∂total/∂gain of the exposure.
    pub by_gain: f64,
    /// ∂total/∂offset of the exposure.
    pub by_offset: f64,
}

impl PhotometricLoss {
    /// Peak signal-to-noise ratio, dB, at most 120.
    pub fn psnr(&self) -> f64 {
        -10.0 * libm::log10(self.mse.max(1e-12))
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
    /// Number of splats that the camera sees.
    pub visible: usize,
    /// Number of splat–tile pairs to blend.
    pub pairs: usize,
    /// Number of pairs beyond the capacity. They belong to the farthest splats and are not blended.
    pub dropped: usize,
}

/// Decay of Adam's first moment (3DGS).
pub(crate) const BETA_1: f32 = 0.9;
/// Decay of Adam's second moment (3DGS).
pub(crate) const BETA_2: f32 = 0.999;
/// Term that keeps the division in Adam's step finite (3DGS).
pub(crate) const EPSILON: f32 = 1e-15;

/// Learning rates of one Adam step. [`AdamRates::at_step`] sets the bias corrections.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AdamRates {
    /// Learning rate of means, world units.
    pub mean: f32,
    /// Learning rate of quaternions.
    pub quat: f32,
    /// Learning rate of log-scales.
    pub log_scale: f32,
    /// Learning rate of opacity logits.
    pub opacity: f32,
    /// Learning rate of the constant colour term.
    pub sh_dc: f32,
    /// Learning rate of the other SH coefficients.
    pub sh_rest: f32,
    /// Bias correction of the first moment, `1 / (1 - β₁^step)`.
    pub first_correction: f32,
    /// Bias correction of the second moment, `1 / (1 - β₂^step)`.
    pub second_correction: f32,
}

impl AdamRates {
    /// Sets the bias corrections `1 / (1 - β^step)` for the `step`-th update, counted from 1.
    pub fn at_step(self, step: u32) -> Self {
        let correction =
            |beta: f32| (1.0 / (1.0 - libm::pow(f64::from(beta), f64::from(step.max(1))))) as f32;
        Self { first_correction: correction(BETA_1), second_correction: correction(BETA_2), ..self }
    }
}

/// A picture rendered from splats. All arrays are stored row by row.
#[derive(Clone, Debug, PartialEq)]
pub struct Rendering {
    /// Width and height, px.
    pub size_px: [u32; 2],
    /// `[h, w, rgb]` colours, 0 and up; the background is black.
    pub rgb: Vec<f32>,
    /// `[h, w]` blended alpha, 0..=1.
    pub alpha: Vec<f32>,
    /// `[h, w]` unbiased depth along the optical axis, world units; 0 where there is no surface. It is `D / -(N · r)`
    /// with the blended plane distance `D`, the blended normal `N` and the ray `r` of the pixel, scaled to z = 1
    /// (PGSR). Empty if only colour was blended.
    pub depth: Vec<f32>,
    /// `[h, w, xyz]` alpha-blended normals in the camera frame, facing the camera, not normalised. Empty if only colour
    /// was blended.
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

/// Shapes of the splats, and the statistics that refinement uses; entry `i` is splat `i`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Shapes {
    /// Means, world units.
    pub means: Vec<[f32; 3]>,
    /// Quaternions, wxyz, not normalised.
    pub quats: Vec<[f32; 4]>,
    /// Natural logarithms of the scales in world units.
    pub log_scales: Vec<[f32; 3]>,
    /// Opacities before the logistic function.
    pub opacity_logits: Vec<f32>,
    /// Mean over views of the norm of ∂L/∂mean on the screen, with screen positions in units of half the picture; 0 if
    /// no view saw the splat.
    pub screen_gradients: Vec<f32>,
    /// Like `screen_gradients`, but each axis of ∂L/∂mean is a sum over pixels of absolute values (AbsGS).
    pub absolute_gradients: Vec<f32>,
    /// Number of times that a view saw the splat since the statistics were last reset.
    pub views: Vec<f32>,
}

/// Contributions of the splats to the scored pictures; entry `i` is splat `i`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scores {
    /// Sum over all pixels of the squared blend weight `(α T)²`, with the alpha α of the splat and the transmittance T
    /// before it. Up to a factor that depends on colours, this is the squared error that removing the splat would
    /// cause.
    pub squared_weights: Vec<f32>,
    /// Number of pixels that the splat was blended into.
    pub hits: Vec<f32>,
    /// Number of views that observe the splat. A view observes a splat if the splat was blended into a pixel while the
    /// transmittance was above one half.
    pub observers: Vec<f32>,
}

/// A new splat. It copies the parameters of `parent`, except for those given here; its optimiser moments are zero.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Birth {
    /// Index of the parent before the edit.
    pub parent: u32,
    /// Mean, world units.
    pub mean: [f32; 3],
    /// Natural logarithms of the scales in world units.
    pub log_scale: [f32; 3],
    /// Opacity before the logistic function.
    pub opacity_logit: f32,
}

/// Splats to add and to remove. New splats first take the places of removed splats, and then go to the end. If there
/// are more removed splats than new ones, splats from the end fill the places that remain.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Edit {
    /// New splats, in order.
    pub births: Vec<Birth>,
    /// Indices of splats to remove, ascending. A removed splat may be a parent.
    pub deaths: Vec<u32>,
}

/// A device that trains and renders. Passes are called in the order of their declaration; each reads what earlier
/// passes left in the backend.
pub trait Backend {
    /// Name of the device for people, such as `cpu avx512 × 2`.
    fn device(&self) -> String;

    /// Why the device was lost; `None` if it works. The results of a lost device are not valid.
    fn lost(&self) -> Option<String> {
        None
    }

    /// Number of splats.
    fn len(&self) -> usize;

    /// True if there are no splats.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Largest number of splats.
    fn capacity(&self) -> usize;

    /// Replaces all splats; moments and statistics become zero. Panics if the splats exceed the capacity.
    fn load(&mut self, splats: &Splats);

    /// The splats as they are now.
    fn splats(&self) -> Splats;

    /// The splats as they are now. Everything else is freed before they are copied, so that less memory is needed.
    fn into_splats(self) -> Splats
    where
        Self: Sized,
    {
        self.splats()
    }

    /// Projects all splats for a camera: computes their 2D Gaussians, their colours (SH up to `sh_degree`) and their
    /// planes.
    fn project(&mut self, camera: &Camera, sh_degree: u32) {
        self.project_up_to(camera, sh_degree, f64::INFINITY);
    }

    /// As [`Backend::project`], but splats whose centres lie deeper than `far` are invisible. `far` is a depth along the
    /// optical axis, world units.
    fn project_up_to(&mut self, camera: &Camera, sh_degree: u32, far: f64);

    /// Makes the list of the splats that each tile blends, nearest first.
    fn bin(&mut self);

    /// Counts of the last binning pass. On a graphics card this waits for the pass, unless [`Backend::losses`] came
    /// after it.
    fn counts(&self) -> BinCounts;

    /// Blends the splats of every tile to a picture.
    fn rasterize(&mut self, channels: Channels);

    /// Keeps the camera and the depth of the last blended picture as the neighbouring view for later calls of
    /// [`Backend::losses`]. The picture must have been blended with [`Channels::Geometry`].
    fn keep_neighbour(&mut self);

    /// Computes the losses of the last blended picture, and their gradient with respect to every pixel.
    fn losses(&mut self, targets: &Targets, weights: &LossWeights) -> Losses;

    /// Computes the gradients with respect to the projected splats.
    fn rasterize_backward(&mut self);

    /// Computes the gradients with respect to the parameters, and adds to the densification statistics.
    fn project_backward(&mut self);

    /// The gradients of the last backward pass, each in the place of its parameter. They are zero for splats that the
    /// camera did not see. For tests and comparisons of backends.
    fn gradients(&self) -> Splats;

    /// Makes one optimiser step on all splats. Splats that the camera did not see have gradient zero.
    fn adam(&mut self, rates: &AdamRates);

    /// The last blended picture.
    fn rendering(&self) -> Rendering;

    /// Runs a job on the processor with the threads of this backend.
    fn with_threads<R: Send>(&self, job: impl FnOnce() -> R + Send) -> R {
        job()
    }

    /// Returns the shapes and statistics for refinement, and resets the statistics to zero.
    fn take_shapes(&mut self) -> Shapes;

    /// Resets all scores to zero.
    fn clear_scores(&mut self);

    /// Increases each splat's scores by the splat's contribution to the last blended picture.
    fn score(&mut self);

    /// False if each of the first `first` splats that the last projected camera could see has scored a hit already. May be
    /// true then as well.
    fn may_score_new_hits(&self, _first: usize) -> bool {
        true
    }

    /// The scores, summed since the last [`Backend::clear_scores`]. An edit makes them meaningless.
    fn scores(&self) -> Scores;

    /// Adds and removes splats. Panics if the result exceeds the capacity.
    fn edit(&mut self, edit: &Edit);

    /// Lowers every opacity to at most `opacity` and resets the moments of opacities to zero.
    fn cap_opacity(&mut self, opacity: f32);

    /// Calls `visit` with all parameters, moments and statistics, in pieces and in a fixed order. Stops at the first
    /// error. The visited numbers form a checkpoint: if [`Backend::import`] restores them on the same device, training
    /// ends with the same bits as without the interruption.
    fn export<E>(&self, visit: impl FnMut(&[f32]) -> Result<(), E>) -> Result<(), E>
    where
        Self: Sized;

    /// Restores `len` splats. Calls `fill` with the pieces that [`Backend::export`] visited, in the same order. Stops
    /// at the first error.
    fn import<E>(&mut self, len: usize, fill: impl FnMut(&mut [f32]) -> Result<(), E>) -> Result<(), E>
    where
        Self: Sized;
}
