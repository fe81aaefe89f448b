//! Merges local models into one (CoSurfGS, "Local Model Compression" and "Model Aggregation Scheme"). Where models
//! overlap, only the one that observed the ground best keeps its splats. The remaining splats of all models are
//! joined. Then the joined model is distilled: it is trained on what each local model renders for its own cameras. No
//! photographs are needed: the aggregator never receives any. The ground is divided into tiles, and each tile is
//! distilled by itself.
//!
//! The result depends only on the models and their order, on the settings, and on the computing device. It has the same
//! bytes for every caller, for any number of threads and for any memory limit. A merge that is interrupted and started
//! again gives the same bytes too.
//!
//! What it knows nothing about: where models are stored ([`Locals`] loads them), and which models can be trusted
//! ([`crate::gate`] decides).
//!
//! Where to start reading: [`merge`], the list of steps; then [`cosurf_engine::compress`]; then [`mod@distill`], which
//! makes a [`plan`] and a [`task`] for each of the [`tiles`] of a [`site`], and lets each [`learn`] from its
//! [`teachers`]; [`results`] for what later merges need not compute again; [`mod@by_workers`] and [`mod@carry_out`] for
//! tiles that other computers distil; [`expected`] for what is believed of a result; [`observed`], [`pages`] and [`splat_file`] for what is kept in files, so that the
//! memory does not grow with the site; [`memory`] for what fits; [`fill_in()`] for models that have arrived only in part.

#![cfg_attr(not(test), warn(clippy::disallowed_methods))]

mod book;
mod by_workers;
pub(crate) mod cameras;
mod carry_out;
mod computer;
mod concat;
mod crop;
mod distill;
mod error;
mod expected;
mod fill_in;
mod ground;
mod learn;
mod lessons;
mod locals;
pub(crate) mod memory;
mod news;
mod observed;
mod pages;
mod patience;
mod plan;
mod results;
mod settings;
pub(crate) mod shifts;
mod site;
mod splat_file;
mod task;
mod teachers;
#[cfg(test)]
mod tests;
mod tiles;

use std::ops::ControlFlow;
use std::path::Path;

use cosurf_engine::Compression;
use cosurf_link::Model;
use cosurf_scene::{Camera, Splats};
use serde::{Deserialize, Serialize};
use tracing::info_span;

use crate::scratch::Scratch;
pub(crate) use carry_out::{CarriedOut, carry_out, give_up};
use computer::Computer;
pub(crate) use concat::concatenate;
pub use distill::MergeProgress;
use distill::distill;
pub use error::MergeError;
pub use fill_in::fill_in;
pub(crate) use ground::Ground;
use lessons::lessons;
pub use locals::{InMemory, Locals, ModelSize};
use locals::{Surveyed, survey};
use memory::{TILE_SPLATS_MAX, check_models};
use observed::Observed;
use plan::ball;
pub use results::{TileRecord, keep_only};
pub use settings::{MergeSettings, Tiles, Workers};
use site::Site;
pub use splat_file::SplatFile;

/// A camera teaches only if its model shows a surface in at least this share of its picture.
const SHOWN_MIN: f64 = 0.1;
/// A picture of a model that was pruned before upload is torn if less than this share of it shows a surface.
const WHOLE_MIN: f64 = 0.9;
/// A model that was pruned before upload teaches only if at most this share of its pictures is torn. Otherwise it has
/// not sent the base of what it gave up, and would teach black.
const TORN_MAX: f64 = 0.1;

/// The share of a model's cameras that do not count for want of splats is told from here on. Up to 2 % of the cameras of
/// honest missions are such.
pub const UNPROVEN_TOLD: f64 = 0.1;

/// A merged model and the figures of its merge.
#[derive(Clone, Debug, PartialEq)]
pub struct Merged {
    /// The global model: its splats and all cameras.
    pub model: Model,
    /// The tiles that the model was distilled in, in the order of their splats; none without distillation.
    pub tiles: Vec<TileRecord>,
    /// The figures of the merge.
    pub summary: MergeSummary,
}

/// A merged model whose splats are in a file, and the figures of its merge.
#[derive(Debug)]
pub struct MergedFile {
    /// The splats of the global model.
    pub splats: SplatFile,
    /// All cameras.
    pub cameras: Vec<Camera>,
    /// As in [`Merged`].
    pub tiles: Vec<TileRecord>,
    /// The figures of the merge.
    pub summary: MergeSummary,
}

impl MergedFile {
    /// Reads the whole model into memory.
    pub fn read(self) -> Result<Merged, MergeError> {
        let Self { splats, cameras, tiles, summary } = self;
        Ok(Merged { model: Model { splats: splats.read()?, cameras }, tiles, summary })
    }
}

/// What a merge works with. It does not change the result.
#[derive(Clone, Copy, Debug)]
pub struct Resources<'a> {
    /// Folder for files with what does not stay in memory; none is left at the end.
    pub scratch: &'a Path,
    /// Who distils the tiles.
    pub tiles: Tiles<'a>,
    /// Number of CPU threads, at least 1.
    pub threads: usize,
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
    /// Number of tiles of the ground that were distilled.
    #[serde(default)]
    pub tiles: usize,
    /// Number of these tiles whose results were known from earlier merges.
    #[serde(default)]
    pub known_tiles: usize,
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
    /// Share of the model's cameras that do not count, because the model has few splats where they look beside others,
    /// 0..=1; 0 without compression.
    #[serde(default)]
    pub unproven: f64,
    /// Number of the model's cameras; 0 in records of version 0.1.
    #[serde(default)]
    pub cameras: usize,
}

/// Merges all of `locals`. Calls `tell` after every step of the distillation; `tell` may stop the merge. If a graphics
/// card that was chosen automatically fails or has too little memory, the merge starts over on the CPU.
pub fn merge(
    locals: &dyn Locals,
    settings: &MergeSettings,
    resources: Resources,
    tell: &mut dyn FnMut(MergeProgress) -> ControlFlow<()>,
) -> Result<Merged, MergeError> {
    merge_to_file(locals, settings, resources, tell)?.read()
}

/// As [`merge`], with the splats of the result in a file in the scratch folder. So the memory that the merge takes does
/// not grow with the site.
pub fn merge_to_file(
    locals: &dyn Locals,
    settings: &MergeSettings,
    resources: Resources,
    tell: &mut dyn FnMut(MergeProgress) -> ControlFlow<()>,
) -> Result<MergedFile, MergeError> {
    merge_in_tiles(locals, settings, resources, TILE_SPLATS_MAX, tell)
}

/// As [`merge_to_file`], with at most `tile_splats` splats in a tile.
fn merge_in_tiles(
    locals: &dyn Locals,
    settings: &MergeSettings,
    resources: Resources,
    tile_splats: usize,
    tell: &mut dyn FnMut(MergeProgress) -> ControlFlow<()>,
) -> Result<MergedFile, MergeError> {
    let _span = info_span!("merge", models = locals.count()).entered();
    check_models(locals, 1, settings.memory_bytes)?;
    let surveyed = survey(locals)?;
    let splats = surveyed.sizes.iter().sum();
    let device = computer::choose(settings, splats, surveyed.sh_degree, &surveyed.cameras)?;
    let computer = Computer { device, threads: resources.threads };
    computer.run(settings.device, |computer| {
        let summary = MergeSummary { device: computer.device.to_string(), ..MergeSummary::default() };
        let tiles = Vec::new();
        let mut merger =
            Merger { surveyed: &surveyed, settings, computer, resources, tile_splats, summary, tiles };
        let splats = merger.merge(tell)?;
        let cameras = surveyed.cameras.concat();
        Ok(MergedFile { splats, cameras, tiles: merger.tiles, summary: merger.summary })
    })
}

/// A merge on one device.
struct Merger<'a> {
    surveyed: &'a Surveyed<'a>,
    settings: &'a MergeSettings,
    computer: &'a Computer,
    resources: Resources<'a>,
    /// Largest number of splats of a tile.
    tile_splats: usize,
    summary: MergeSummary,
    tiles: Vec<TileRecord>,
}

impl Merger<'_> {
    fn merge(
        &mut self,
        tell: &mut dyn FnMut(MergeProgress) -> ControlFlow<()>,
    ) -> Result<SplatFile, MergeError> {
        // A single model has nothing to learn: it would be its own teacher.
        let is_taught = self.settings.epochs > 0 && self.surveyed.sizes.len() > 1;
        let scratch = Scratch::new(self.resources.scratch)?;
        let is_observed = self.settings.compress || is_taught;
        let observe = || Observed::of(self.surveyed, self.computer, &scratch);
        let observed = is_observed.then(observe).transpose()?;
        let splats = match observed {
            Some(observed) if is_taught => self.taught(scratch, observed, tell)?,
            observed => self.joined(&scratch, observed.as_ref())?,
        };
        self.summary.splats = splats.len();
        Ok(splats)
    }

    /// The splats of all models that stay after compression.
    fn joined(&mut self, scratch: &Scratch, observed: Option<&Observed>) -> Result<SplatFile, MergeError> {
        let mut joined = SplatFile::new(scratch, self.surveyed.sh_degree)?;
        let wide = Model { splats: Splats::with_capacity(0, self.surveyed.sh_degree), cameras: Vec::new() };
        for i in 0..self.surveyed.sizes.len() {
            let Model { splats, .. } = self.surveyed.locals.load(i)?;
            let kept = self.compressed(i, &splats, observed)?;
            // Pads lower degrees of spherical harmonics.
            let kept = concatenate(&[Model { splats: kept, cameras: Vec::new() }, wide.clone()]);
            joined.append(&kept.splats)?;
        }
        Ok(joined)
    }

    /// The same after distillation.
    fn taught(
        &mut self,
        scratch: Scratch,
        observed: Observed,
        tell: &mut dyn FnMut(MergeProgress) -> ControlFlow<()>,
    ) -> Result<SplatFile, MergeError> {
        let Surveyed { locals, cameras, sizes, sh_degree } = self.surveyed;
        let mut site = Site::new(scratch, cameras, observed, *sh_degree)?;
        for i in 0..sizes.len() {
            let model = locals.load(i)?;
            let kept = self.compressed(i, &model.splats, Some(&site.observed))?;
            site.add(&model, &kept)?;
        }
        let standings = match self.settings.compress {
            true => Some(standings(&site.observed, self.surveyed)?),
            false => None,
        };
        let teaches = |local: usize| standings.is_some() || !locals.is_compressed(local);
        let mut lessons = lessons(cameras, standings.as_deref(), teaches);
        for (local, its) in lessons.iter_mut().enumerate() {
            its.retain(|camera| site.observed.are_new(local)[*camera]);
        }
        let tiles = site.tiles(self.tile_splats)?;
        let by = self.resources.tiles;
        let distilled = distill(&site, tiles, &lessons, self.settings, self.computer, by, tell)?;
        self.summary.steps = distilled.steps;
        (self.summary.tiles, self.summary.known_tiles) = (distilled.tiles.len(), distilled.found);
        self.tiles = distilled.tiles;
        Ok(distilled.splats)
    }

    /// The splats of a model that stay after compression.
    fn compressed(
        &mut self,
        index: usize,
        splats: &Splats,
        observed: Option<&Observed>,
    ) -> Result<Splats, MergeError> {
        let (Compression { overlap, removed }, unproven) = match observed.filter(|_| self.settings.compress) {
            Some(observed) => {
                let (center, radius) = ball(&splats.means);
                let (observers, own) = observed.around(index, center, radius)?;
                (Compression::plan(splats, own, &observers), observed.unproven(index))
            }
            None => (Compression::default(), 0.0),
        };
        let (arrived, lost) = (splats.len(), removed.len());
        let cameras = self.surveyed.cameras[index].len();
        self.summary.locals.push(LocalSummary { arrived, overlap, removed: lost, unproven, cameras });
        self.summary.joined += arrived - lost;
        Ok(splats.without(&removed))
    }
}

/// The standing of each model at each of its cameras; 0 for cameras that see hardly any surface, and for all cameras of
/// a model that cannot teach.
fn standings(observed: &Observed, surveyed: &Surveyed) -> Result<Vec<Vec<f64>>, MergeError> {
    let of = |local: usize| -> Result<Vec<f64>, MergeError> {
        let shown = observed.shown(local);
        let torn = shown.iter().filter(|shown| **shown < WHOLE_MIN).count();
        let is_torn = surveyed.locals.is_compressed(local) && torn as f64 > TORN_MAX * shown.len() as f64;
        let teaches = |shown: f64| !is_torn && shown >= SHOWN_MIN;
        let standings = observed.standings(local)?.into_iter().zip(shown);
        Ok(standings.map(|(standing, shown)| if teaches(*shown) { standing } else { 0.0 }).collect())
    };
    (0..surveyed.sizes.len()).map(of).collect()
}
