//! A merge on its own thread. Before the merge, the gate decides which models take part ([`crate::gate`]).

use std::ops::ControlFlow;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, Receiver, Sender};
use std::thread::{self, JoinHandle};

use cosurf_link::{Model, ModelKey, ModelStore, body_to_model, scene_frame};
use cosurf_scene::{LocalFrame, evenly_spaced};
use cosurf_wire::{ModelHeader, ModelKind};
use tracing::info_span;

use super::cut::Cut;
use super::inputs::{Input, Inputs};
use super::pack::packed;
use super::record::{Fitted, KeptOut, Merging, Verdict};
use super::trial::Watch;
use crate::gate::{Workspace, admit, admit_part};
use crate::merge::{
    Locals, MergeError, MergeProgress, MergeSettings, Merged, ModelSize, Resources, Tiles, Workers, fill_in,
    merge,
};
use crate::queue::Queue;
use crate::store::Store;

/// Largest number of cameras of a model that a merge looks at; of more, evenly spaced ones are taken. Each takes about
/// 10 kB and a millisecond, and a listed device may claim any number of them.
const CAMERAS_MAX: usize = 4096;
/// Number of distillation steps between two reports of progress.
const TELL_EVERY: u32 = 50;

/// The stores of complete models and of parts.
#[derive(Clone, Debug)]
pub(super) struct Stores {
    pub(super) whole: ModelStore,
    pub(super) parts: ModelStore,
}

/// A running merge. Dropping it stops the merge.
#[derive(Debug)]
pub(super) struct Job {
    pub(super) inputs: Inputs,
    /// The record of the older revision that is restored instead of merging the inputs.
    pub(super) restores: Option<Box<Merging>>,
    stop: Arc<AtomicBool>,
    progress: Receiver<MergeProgress>,
    /// Lines about trouble with tiles.
    troubles: Receiver<String>,
    thread: Option<JoinHandle<Result<Outcome, MergeError>>>,
}

/// Who distils the tiles of merges, and where their results are kept.
#[derive(Clone, Debug)]
pub(super) struct TileWork {
    pub(super) results: Store,
    /// The queue of workers; without it, the tiles are distilled here.
    pub(super) queue: Option<Arc<Queue>>,
    /// A global model with more splats is sent in tiles.
    pub(super) whole_splats_max: usize,
}

impl TileWork {
    /// `say` gets a line for each trouble with a tile.
    fn tiles<'a>(&'a self, say: &'a Sender<String>) -> Tiles<'a> {
        let (store, patience) = (&self.results, Workers::PATIENCE);
        match &self.queue {
            Some(queue) => Tiles::ByWorkers(Workers { store, queue, patience, say }),
            None => Tiles::Kept(&self.results),
        }
    }
}

/// What a round merges, and with what.
struct Round {
    parts: Stored,
    /// The frame of the site, which the merge computes in.
    frame: LocalFrame,
    settings: MergeSettings,
    scratch: PathBuf,
    work: TileWork,
    threads: usize,
    say: Sender<MergeProgress>,
    say_trouble: Sender<String>,
    stop: Arc<AtomicBool>,
}

/// What came of an attempt to merge.
enum Attempt {
    Over(Box<Outcome>),
    /// The models with these indices are too large for the memory of the merge.
    TooLarge {
        locals: Vec<usize>,
        /// What is too large about them, and what to do.
        reason: String,
    },
}

impl Attempt {
    /// The attempt that failed with `error`, if the others can be merged without the models that it names. `of_all` gives the
    /// index of a model among all of them.
    fn of_error(error: MergeError, of_all: impl Fn(usize) -> usize) -> Result<Self, MergeError> {
        let (locals, excess, needed_bytes) = match error {
            MergeError::ModelsTooLarge { locals, needed_bytes, .. } => (locals, Excess::Splats, needed_bytes),
            MergeError::PicturesTooLarge { locals, needed_bytes, .. } => {
                (locals, Excess::Pictures, needed_bytes)
            }
            other => return Err(other),
        };
        let locals = locals.into_iter().map(of_all).collect();
        Ok(Self::TooLarge { locals, reason: excess.reason(needed_bytes) })
    }
}

impl Round {
    /// Merges `stored`, then adds the parts.
    fn attempt(&self, stored: &Stored) -> Result<Attempt, MergeError> {
        let Self { parts, frame, settings, scratch, work, threads, say, say_trouble, stop } = self;
        let threads = *threads;
        let is_stopped = || stop.load(Ordering::Relaxed);
        let workspace = Workspace::of(settings, scratch, threads);
        let admitted = match admit(stored, settings.into(), workspace, &is_stopped) {
            Ok(admitted) => admitted,
            Err(error) => return Attempt::of_error(error, |local| local),
        };
        let mut verdict = Verdict::of(&admitted, &stored.headers, frame);
        if admitted.count() == 0 {
            return Ok(Attempt::Over(Box::new(Outcome { made: None, verdict })));
        }
        let resources = Resources { scratch, tiles: work.tiles(say_trouble), threads };
        let merged = merge(&admitted, settings, resources, &mut |progress: MergeProgress| {
            if progress.step.is_multiple_of(TELL_EVERY) {
                let _ = say.send(progress); // fails only if the job was dropped
            }
            if is_stopped() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        });
        let mut merged = match merged {
            Ok(merged) => merged,
            Err(error) => return Attempt::of_error(error, |place| admitted.place(place).local),
        };
        for i in 0..parts.count() {
            merged.model =
                parts.fill_into(merged.model, i, settings, resources, &is_stopped, &mut verdict)?;
        }
        merged.summary.splats = merged.model.splats.len();
        let body = packed(&merged.model, frame, threads, &is_stopped)?;
        let cut = (merged.model.splats.len() > work.whole_splats_max).then(|| {
            let local = |place: usize| {
                let device = stored.headers[admitted.place(place).local].device;
                Ok((device, admitted.load(place)?.splats))
            };
            let locals = (0..admitted.count()).map(local);
            Cut::of(&merged.model, frame, work.whole_splats_max, locals, threads, &is_stopped)
        });
        let made = Some(Made { merged, frame: *frame, body, cut: cut.transpose()? });
        Ok(Attempt::Over(Box::new(Outcome { made, verdict })))
    }
}

/// What takes too much memory about a model.
enum Excess {
    Splats,
    Pictures,
}

impl Excess {
    /// Why the model is left out, and what to do. `needed_bytes` would suffice.
    fn reason(self, needed_bytes: u64) -> String {
        let (what, less) = match self {
            Self::Splats => ("more splats than fit into", "with less memory"),
            Self::Pictures => ("pictures that are too large for", "on smaller pictures"),
        };
        let needed_mib = needed_bytes.div_ceil(1 << 20);
        format!("has {what} the memory of merges: raise merge_memory to {needed_mib} MiB, or train it {less}")
    }
}

/// The result of a merge.
pub(super) struct Outcome {
    /// The global model; `None` if no model took part.
    pub(super) made: Option<Made>,
    /// What the gate decided about the models.
    pub(super) verdict: Verdict,
}

/// A global model, encoded.
pub(super) struct Made {
    pub(super) merged: Merged,
    /// The frame of the merged model.
    pub(super) frame: LocalFrame,
    pub(super) body: Vec<u8>,
    /// The model in tiles, if it is too large to be sent whole.
    pub(super) cut: Option<Cut>,
}

/// The state of a merge.
pub(super) enum JobState {
    /// Nothing has changed since the last poll.
    Unchanged,
    /// The merge has made progress.
    Advanced(MergeProgress),
    /// There was trouble with a tile.
    Troubled(String),
    /// The merge has ended.
    Done(Box<Result<Outcome, MergeError>>),
}

/// Models in a store, loaded when they are needed.
struct Stored {
    models: ModelStore,
    headers: Vec<ModelHeader>,
    /// The frame that they are loaded into.
    frame: LocalFrame,
    watch: Option<Arc<Watch>>,
}

impl Stored {
    /// Returns the models to merge, and the parts to add to the merged model. If no model has arrived completely, the
    /// parts are merged with each other.
    fn of(stores: Stores, inputs: Inputs, watch: Option<Arc<Watch>>) -> (Self, Self) {
        let frame = LocalFrame::WORLD;
        let whole = Self { models: stores.whole, headers: inputs.whole, frame, watch: watch.clone() };
        let parts = Self { models: stores.parts, headers: inputs.parts, frame, watch };
        if whole.headers.is_empty() { (parts, whole) } else { (whole, parts) }
    }

    /// The frame that suits each model.
    fn frames(&self) -> Result<Vec<LocalFrame>, MergeError> {
        let frame = |header| {
            Watch::reads(self.watch.as_ref(), header);
            Ok(scene_frame(&self.models.get(ModelKey::from(header))?.1)?)
        };
        self.headers.iter().map(frame).collect()
    }

    /// Leaves out the models at these indices for this reason.
    fn leave_out(&mut self, locals: &[usize], reason: &str) -> Vec<KeptOut> {
        let left_out =
            locals.iter().map(|local| KeptOut::new(&self.headers[*local], reason.to_owned())).collect();
        let is_left = |index: usize| !locals.contains(&index);
        self.headers = (0..self.count()).filter(|i| is_left(*i)).map(|i| self.headers[i]).collect();
        left_out
    }

    /// Adds the part at `index` to a merged model, if it fits. Notes in `verdict` what the gate decided.
    fn fill_into(
        &self,
        merged: Model,
        index: usize,
        settings: &MergeSettings,
        resources: Resources,
        is_stopped: &dyn Fn() -> bool,
        verdict: &mut Verdict,
    ) -> Result<Model, MergeError> {
        let (header, part) = (&self.headers[index], self.load(index)?);
        let Resources { scratch, threads, .. } = resources;
        let workspace = Workspace::of(settings, scratch, threads);
        let is_compressed = self.is_compressed(index);
        match admit_part(&merged, &part, is_compressed, settings.into(), workspace, is_stopped)? {
            Ok(place) => {
                verdict.fitted.extend(Fitted::of(header.device.as_str(), place, &self.frame));
                let moved = place.by.map(|by| by.by.model(&part));
                Ok(fill_in(merged, moved.as_ref().unwrap_or(&part)))
            }
            Err(doubt) => {
                let reason = doubt.reason(&["the other models", header.device.as_str()]);
                verdict.kept_out.push(KeptOut::new(header, reason));
                Ok(merged)
            }
        }
    }
}

impl Locals for Stored {
    fn count(&self) -> usize {
        self.headers.len()
    }

    fn size(&self, index: usize) -> Result<ModelSize, MergeError> {
        let ModelHeader { splats, sh_degree, .. } = self.headers[index];
        Ok(ModelSize { splats: splats as usize, sh_degree: sh_degree.into() })
    }

    fn load(&self, index: usize) -> Result<Model, MergeError> {
        Watch::reads(self.watch.as_ref(), &self.headers[index]);
        let (_, body) = self.models.get(ModelKey::from(&self.headers[index]))?;
        let Model { splats, cameras } = body_to_model(&body, &self.frame)?;
        Ok(Model { splats, cameras: evenly_spaced(&cameras, CAMERAS_MAX) })
    }

    fn is_compressed(&self, index: usize) -> bool {
        self.headers[index].kind == ModelKind::Compressed
    }

    fn is_placed(&self, index: usize) -> bool {
        self.headers[index].is_placed()
    }
}

impl Job {
    /// `scratch` is a folder for files of the merge. `watch` is told which model is read.
    pub(super) fn start(
        stores: Stores,
        inputs: Inputs,
        settings: MergeSettings,
        scratch: PathBuf,
        work: TileWork,
        threads: usize,
        watch: Option<Arc<Watch>>,
    ) -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let (say, progress) = mpsc::channel();
        let (say_trouble, troubles) = mpsc::channel();
        let (mut stored, mut parts) = Stored::of(stores, inputs.clone(), watch);
        let stop_of_round = stop.clone();
        let thread = thread::spawn(move || {
            let _span = info_span!("round", models = stored.count(), parts = parts.count()).entered();
            let frame = LocalFrame::most_common(&[stored.frames()?, parts.frames()?].concat());
            (stored.frame, parts.frame) = (frame, frame);
            let stop = stop_of_round;
            let round = Round { parts, frame, settings, scratch, work, threads, say, say_trouble, stop };
            let mut left_out = Vec::new();
            loop {
                match round.attempt(&stored)? {
                    Attempt::Over(mut outcome) => {
                        outcome.verdict.keep_out(left_out);
                        return Ok(*outcome);
                    }
                    Attempt::TooLarge { locals, reason } => {
                        left_out.extend(stored.leave_out(&locals, &reason));
                    }
                }
            }
        });
        Self { inputs, restores: None, stop, progress, troubles, thread: Some(thread) }
    }

    /// Reads the older revision `key` of `globals` instead of merging. `record` is its own, and `inputs` are the models that
    /// count now: of a large model, their devices get the tiles with their ground.
    pub(super) fn restore(
        globals: ModelStore,
        key: ModelKey,
        record: Merging,
        stores: Stores,
        inputs: Inputs,
        work: TileWork,
        threads: usize,
    ) -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let ((_, progress), (_, troubles)) = (mpsc::channel(), mpsc::channel());
        let (mut stored, _) = Stored::of(stores, inputs.clone(), None);
        let (is_stopped, restored) = (stop.clone(), record.clone());
        let thread = thread::spawn(move || {
            let _span = info_span!("restore", revision = %key.model).entered();
            let is_stopped = || is_stopped.load(Ordering::Relaxed);
            let (_, body) = globals.get(key)?;
            let frame = scene_frame(&body)?;
            stored.frame = frame;
            let model = body_to_model(&body, &frame)?;
            let locals = (0..stored.count()).map(|i| Ok((stored.headers[i].device, stored.load(i)?.splats)));
            let whole_max = work.whole_splats_max;
            let cut = (model.splats.len() > whole_max)
                .then(|| Cut::of(&model, &frame, whole_max, locals, threads, &is_stopped));
            let Merging { kept_out, fitted, fits, summary, .. } = restored;
            let merged = Merged { model, tiles: Vec::new(), summary };
            let made = Some(Made { merged, frame, body, cut: cut.transpose()? });
            Ok(Outcome { made, verdict: Verdict { kept_out, fitted, fits } })
        });
        let (restores, thread) = (Some(Box::new(record)), Some(thread));
        Self { inputs, restores, stop, progress, troubles, thread }
    }

    /// The models of the result, as `merged.json` records them.
    pub(super) fn recorded(&self) -> Vec<Input> {
        self.restores.as_ref().map_or_else(|| self.inputs.recorded(), |record| record.inputs.clone())
    }

    /// Returns the state of the merge without waiting. The result comes once, with [`JobState::Done`].
    pub(super) fn poll(&mut self) -> JobState {
        if let Ok(trouble) = self.troubles.try_recv() {
            return JobState::Troubled(trouble);
        }
        if let Ok(progress) = self.progress.try_recv() {
            return JobState::Advanced(progress);
        }
        match self.thread.take_if(|thread| thread.is_finished()) {
            Some(thread) => JobState::Done(Box::new(thread.join().unwrap_or(Err(MergeError::Panicked)))),
            None => JobState::Unchanged,
        }
    }
}

impl Drop for Job {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_merge_that_panics_is_told_as_a_defect_of_the_program() {
        let (_, progress) = mpsc::channel();
        let thread = thread::spawn(|| panic!("on purpose"));
        let (stop, thread, (_, troubles)) = (Arc::default(), Some(thread), mpsc::channel());
        let mut job = Job { inputs: Inputs::default(), restores: None, stop, progress, troubles, thread };
        let outcome = loop {
            match job.poll() {
                JobState::Unchanged => thread::yield_now(),
                JobState::Advanced(_) | JobState::Troubled(_) => unreachable!("the merge makes no progress"),
                JobState::Done(outcome) => break outcome,
            }
        };
        let error = outcome.err().unwrap();
        assert!(matches!(error, MergeError::Panicked), "{error}");
        assert!(error.to_string().contains("internal error"), "{error}");
    }
}
