//! Merges local models into one (CoSurfGS, "Local Model Compression" and "Model Aggregation Scheme"). Where models
//! overlap, one model keeps its splats; the rest is joined; then the joined model is distilled: it learns from what
//! each local model shows its own cameras. Photographs are neither needed nor available.
//!
//! The result is a function of the models in their order, of the settings and of the device: it has the same bytes for
//! any caller, with any number of threads, interrupted or not.
//!
//! It refuses to know where models come from ([`Locals`]) and which of them are to be trusted ([`crate::gate`]).
//!
//! Where to start reading: [`merge`], which reads as the list of steps; [`cosurf_engine::compress`]; [`distill`], its
//! [`lessons`] and [`teachers`]; [`memory`] for what fits; [`fill_in()`] for models that have arrived only in part.

pub(crate) mod cameras;
mod computer;
mod concat;
mod distill;
mod error;
mod fill_in;
mod lessons;
mod locals;
mod memory;
mod settings;
mod teachers;
#[cfg(test)]
mod tests;

use std::ops::ControlFlow;

use cosurf_engine::{Compression, ModelCameras};
use cosurf_link::Model;
use serde::{Deserialize, Serialize};
use tracing::{debug_span, info_span};

use computer::Computer;
pub(crate) use concat::concatenate;
pub use distill::MergeProgress;
pub use error::MergeError;
pub use fill_in::fill_in;
pub use locals::Locals;
use locals::{Surveyed, survey};
pub use settings::MergeSettings;

/// A merged model and the figures of its merge.
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
    /// Splats of the joined model, after compression.
    pub joined: usize,
    /// Splats after distillation and its last pruning.
    pub splats: usize,
    /// Steps of distillation.
    pub steps: u32,
    /// The device that computed.
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

/// Merges all of `locals` with `threads` (at least 1) threads of the CPU. `tell` is called after every step and may
/// stop the merge. If a graphics card fails that was chosen automatically, the merge starts over on the CPU.
pub fn merge(
    locals: &dyn Locals,
    settings: &MergeSettings,
    threads: usize,
    tell: &mut dyn FnMut(MergeProgress) -> ControlFlow<()>,
) -> Result<Merged, MergeError> {
    let _span = info_span!("merge", models = locals.count()).entered();
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
                let fleet = ModelCameras { cameras: &surveyed.cameras, own: i };
                Compression::plan(&splats, &cameras, &fleet, &computer.device, computer.threads)?
            }
            false => Compression::default(),
        };
        let splats = splats.without(&compression.removed);
        let removed = compression.removed.len();
        summary.locals.push(LocalSummary { arrived, overlap: compression.overlap, removed });
        parts.push(Model { splats, cameras });
    }
    let mut model = debug_span!("join").in_scope(|| concatenate(&parts));
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
