//! Merges local models into one (CoSurfGS, "Local Model Compression" and "Model Aggregation Scheme"). Where models
//! overlap, only the one or two that observed the ground best keep their splats. The remaining splats of all models are
//! joined. Then the joined model is distilled: it is trained on what each local model renders for its own cameras. No
//! photographs are needed: the aggregator never receives any.
//!
//! The result depends only on the models and their order, on the settings, and on the computing device. It has the same
//! bytes for every caller and for any number of threads. A merge that is interrupted and started again gives the same
//! bytes too.
//!
//! What it knows nothing about: where models are stored ([`Locals`] loads them), and which models can be trusted
//! ([`crate::gate`] decides).
//!
//! Where to start reading: [`merge`], the list of steps; then [`cosurf_engine::compress`]; then [`distill`] with its
//! [`lessons`] and [`teachers`]; [`memory`] for what fits into the memory; [`fill_in()`] for models that have arrived
//! only in part.

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

use cosurf_engine::{Compression, Observers};
use cosurf_link::Model;
use serde::{Deserialize, Serialize};
use tracing::{debug_span, info_span};

use computer::Computer;
pub(crate) use concat::concatenate;
pub use distill::MergeProgress;
pub use error::MergeError;
pub use fill_in::fill_in;
pub use locals::{InMemory, Locals};
use locals::{Surveyed, survey};
pub use settings::MergeSettings;

/// A camera teaches only if its model shows a surface in at least this share of its picture.
const SHOWN_MIN: f64 = 0.1;
/// A picture of a model that was pruned before upload is torn if less than this share of it shows a surface.
const WHOLE_MIN: f64 = 0.9;
/// A model that was pruned before upload teaches only if at most this share of its pictures is torn. Otherwise it has
/// not sent the base of what it gave up, and would teach black.
const TORN_MAX: f64 = 0.1;

/// A merged model and the figures of its merge.
#[derive(Clone, Debug, PartialEq)]
pub struct Merged {
    /// The global model: its splats and all cameras.
    pub model: Model,
    /// The figures of the merge.
    pub summary: MergeSummary,
}

/// The figures of a merge.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct MergeSummary {
    /// One entry for each local model, in the order of the models.
    pub locals: Vec<LocalSummary>,
    /// Number of splats of the joined model, after compression.
    pub joined: usize,
    /// Number of splats of the global model. Distillation ends by removing useless splats.
    pub splats: usize,
    /// Number of distillation steps.
    pub steps: u32,
    /// The device that computed the merge, for example `cpu`.
    #[serde(default)]
    pub device: String,
}

/// The figures of one local model.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LocalSummary {
    /// Number of splats that arrived.
    pub arrived: usize,
    /// Share of the model's splats on ground that other models saw too, 0..=1; 0 without compression.
    pub overlap: f64,
    /// Number of splats that compression removed.
    pub removed: usize,
}

/// Merges all of `locals` with `threads` (at least 1) CPU threads. Calls `tell` after every step of the distillation;
/// `tell` may stop the merge. If a graphics card that was chosen automatically fails, the merge starts over on the CPU.
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
    let observers = if settings.compress { Some(observers(computer, surveyed)?) } else { None };
    let mut parts = Vec::with_capacity(surveyed.sizes.len());
    for (i, &arrived) in surveyed.sizes.iter().enumerate() {
        let Model { splats, cameras } = surveyed.locals.load(i)?;
        let plan = |observers| Compression::plan(&splats, i, observers);
        let Compression { overlap, removed } = observers.as_ref().map(plan).unwrap_or_default();
        summary.locals.push(LocalSummary { arrived, overlap, removed: removed.len() });
        parts.push(Model { splats: splats.without(&removed), cameras });
    }
    let mut model = debug_span!("join").in_scope(|| concatenate(&parts));
    summary.joined = model.splats.len();
    // A single model has nothing to learn: it would be its own teacher.
    let is_taught = settings.epochs > 0 && parts.len() > 1;
    if is_taught && !model.splats.is_empty() && !model.cameras.is_empty() {
        let sizes: Vec<usize> = parts.iter().map(|part| part.splats.len()).collect();
        drop(parts);
        let standings: Option<Vec<Vec<f64>>> = observers.map(|observers| standings(&observers, surveyed));
        let distilled =
            distill::distill(surveyed, &sizes, model.splats, standings.as_deref(), settings, computer, tell)?;
        (model.splats, summary.steps) = (distilled.splats, distilled.steps);
    }
    summary.splats = model.splats.len();
    Ok(Merged { model, summary })
}

/// The standing of each model at each of its cameras; 0 for cameras that see hardly any surface, and for all cameras of
/// a model that cannot teach.
fn standings(observers: &Observers, surveyed: &Surveyed) -> Vec<Vec<f64>> {
    let of = |local: usize| {
        let shown = observers.shown(local);
        let torn = shown.iter().filter(|shown| **shown < WHOLE_MIN).count();
        let is_torn = surveyed.locals.is_compressed(local) && torn as f64 > TORN_MAX * shown.len() as f64;
        let standings = observers.standings(local).into_iter().zip(shown);
        let teaches = |shown: f64| !is_torn && shown >= SHOWN_MIN;
        standings.map(|(standing, shown)| if teaches(shown) { standing } else { 0.0 }).collect()
    };
    (0..surveyed.sizes.len()).map(of).collect()
}

/// What the cameras of all models observed. Devices that prune their models before upload judge by the cameras alone.
/// If any model was pruned, the aggregator uses the same rule, so that it assigns no place to a model that has already
/// dropped it.
fn observers(computer: &Computer, surveyed: &Surveyed) -> Result<Observers, MergeError> {
    let mut observers = Observers::default();
    let locals = surveyed.locals;
    if (0..locals.count()).any(|i| locals.is_compressed(i)) {
        observers.judge_as_announced();
    }
    for i in 0..surveyed.sizes.len() {
        let Model { splats, cameras } = locals.load(i)?;
        observers.add(&splats, &cameras, locals.weight(i), &computer.device, computer.threads)?;
    }
    Ok(observers)
}
