//! Local models to one (CoSurfGS, "Local Model Compression" and "Model Aggregation Scheme"): what several models
//! show is left to one of them, the rest is joined, and the joined model is taught by what each local model
//! showed its own cameras. No photograph is needed, nor is there one to be had.
//!
//! The result is a function of the models in their order, of the settings and of the device: the same bytes whoever
//! merges, with any number of threads, interrupted or not.
//!
//! Reading order: [`merge`], which reads as the list of steps; [`cosurf_engine::compress`]; [`distill`], its [`lessons`] and
//! [`teachers`].

mod computer;
mod concat;
mod distill;
mod lessons;
mod teachers;
#[cfg(test)]
pub(crate) mod tests;

use std::ops::ControlFlow;

use cosurf_engine::{Compression, DeviceChoice, DeviceError, Fleet};
use cosurf_link::{BodyFault, Model, StoreError};
use cosurf_scene::{Camera, SceneError};
use glam::DVec3;
use serde::{Deserialize, Serialize};

use computer::Computer;
pub(crate) use concat::concatenate;

/// How models are merged.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct MergeSettings {
    /// Times that every camera is learnt from (CoSurfGS: 5); 0 leaves the models as they were joined.
    pub epochs: u32,
    /// Whether what several models show is left to one of them first.
    pub compress: bool,
    /// Whether models that lie in another frame than the others are moved to where they fit, rather than kept out; see
    /// [`crate::gate`].
    pub refine: bool,
    /// Bytes that the models and their training may take together. Where they do not suffice for all at once,
    /// teachers wait on the disk and the cells are distilled one after the other; that changes the result.
    pub memory_bytes: u64,
    /// Seed of every random choice.
    pub seed: u64,
    /// What computes; the same bytes are those of one device.
    #[serde(default)]
    pub device: DeviceChoice,
}

impl Default for MergeSettings {
    fn default() -> Self {
        Self {
            epochs: 5,
            compress: true,
            refine: false,
            memory_bytes: 4 << 30,
            seed: 0,
            device: DeviceChoice::Auto,
        }
    }
}

/// Local models in a fixed order, read when they are needed.
pub trait Locals {
    /// How many there are.
    fn count(&self) -> usize;

    /// Reads one.
    fn load(&self, index: usize) -> Result<Model, MergeError>;

    /// Whether one has left ground to others before it was sent: there it shows nothing, and it teaches nothing.
    fn is_compressed(&self, index: usize) -> bool {
        let _ = index;
        false
    }
}

/// Why models are not merged.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MergeError {
    /// A model could not be read from its store.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A model could not be read from its folder.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// A model is not what it should be.
    #[error(transparent)]
    Body(#[from] BodyFault),
    /// What was to compute cannot, or could not to the end.
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// The owner said stop.
    #[error("the merge was given up")]
    GivenUp,
}

/// How far a merge has come.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct MergeProgress {
    /// Steps of distillation done.
    pub step: u32,
    /// Steps in all.
    pub steps: u32,
    /// Agreement with the teacher at the last step, dB.
    pub psnr: f64,
}

/// A merged model and what became of the local ones.
#[derive(Clone, Debug, PartialEq)]
pub struct Merged {
    /// The global model: its splats and all cameras.
    pub model: Model,
    /// The figures.
    pub summary: MergeSummary,
}

/// The figures of a merge.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct MergeSummary {
    /// Per local model, in their order.
    pub locals: Vec<LocalSummary>,
    /// Splats that were joined, after compression.
    pub joined: usize,
    /// Splats after distillation and its last pruning.
    pub splats: usize,
    /// Steps of distillation.
    pub steps: u32,
    /// What computed.
    #[serde(default)]
    pub device: String,
}

/// What became of one local model.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LocalSummary {
    /// Splats that arrived.
    pub arrived: usize,
    /// Ψ: share of its cameras that look at ground of another model.
    pub overlap: f64,
    /// Splats that compression removed.
    pub removed: usize,
}

/// Merges all of `locals`; `threads` (at least 1) are the processor's. `tell` hears of every step and may give up. Where
/// a graphics card that nobody asked for fails, the processor begins anew.
pub fn merge(
    locals: &dyn Locals,
    settings: &MergeSettings,
    threads: usize,
    tell: &mut dyn FnMut(MergeProgress) -> ControlFlow<()>,
) -> Result<Merged, MergeError> {
    let surveyed = survey(locals)?;
    let splats = surveyed.sizes.iter().sum();
    let device = computer::choose(settings, splats, surveyed.sh_degree, &surveyed.cameras)?;
    let computer = Computer { device, threads };
    computer.run(settings.device, |computer| merge_by(computer, &surveyed, settings, tell))
}

fn merge_by(
    computer: &Computer,
    surveyed: &Surveyed,
    settings: &MergeSettings,
    tell: &mut dyn FnMut(MergeProgress) -> ControlFlow<()>,
) -> Result<Merged, MergeError> {
    let mut summary = MergeSummary { device: computer.device.to_string(), ..MergeSummary::default() };
    let mut parts = Vec::with_capacity(surveyed.sizes.len());
    for (i, &arrived) in surveyed.sizes.iter().enumerate() {
        let Model { splats, cameras } = surveyed.locals.load(i)?;
        let compression = match settings.compress {
            true => {
                let fleet = Fleet { cameras: &surveyed.cameras, own: i };
                Compression::plan(&splats, &cameras, &fleet, &computer.device, computer.threads)?
            }
            false => Compression::default(),
        };
        let splats = splats.without(&compression.removed);
        let removed = compression.removed.len();
        summary.locals.push(LocalSummary { arrived, overlap: compression.overlap, removed });
        parts.push(Model { splats, cameras });
    }
    let mut model = concatenate(&parts);
    summary.joined = model.splats.len();
    if settings.epochs > 0 && !model.splats.is_empty() && !model.cameras.is_empty() {
        let sizes: Vec<usize> = parts.iter().map(|part| part.splats.len()).collect();
        drop(parts);
        let distilled = distill::distill(surveyed, &sizes, model.splats, settings, computer, tell)?;
        (model.splats, summary.steps) = (distilled.splats, distilled.steps);
    }
    summary.splats = model.splats.len();
    Ok(Merged { model, summary })
}

/// Local models, and what is known of them before the first is merged.
pub(crate) struct Surveyed<'a> {
    locals: &'a dyn Locals,
    /// Those of each.
    cameras: Vec<Vec<Camera>>,
    /// Splats of each.
    sizes: Vec<usize>,
    /// The highest.
    sh_degree: u32,
}

fn survey(locals: &dyn Locals) -> Result<Surveyed<'_>, MergeError> {
    let mut surveyed = Surveyed { locals, cameras: Vec::new(), sizes: Vec::new(), sh_degree: 0 };
    for i in 0..locals.count() {
        let Model { splats, cameras } = locals.load(i)?;
        surveyed.sizes.push(splats.len());
        surveyed.sh_degree = surveyed.sh_degree.max(splats.sh_degree);
        surveyed.cameras.push(cameras);
    }
    Ok(surveyed)
}

/// Mean of the places of some cameras; the origin for none.
pub(crate) fn middle(cameras: &[Camera]) -> DVec3 {
    cameras.iter().map(|camera| camera.cam_from_world.center()).sum::<DVec3>() / cameras.len().max(1) as f64
}

/// From there to the farthest of them, world units.
pub(crate) fn radius(cameras: &[Camera], middle: DVec3) -> f64 {
    cameras.iter().map(|camera| camera.cam_from_world.center().distance(middle)).fold(0.0, f64::max)
}
