//! A merge on a thread of its own: first it is judged who takes part ([`crate::gate`]).

use std::ops::ControlFlow;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, Receiver};
use std::thread::{self, JoinHandle};

use cosurf_link::{Model, ModelKey, ModelStore, body_to_model};
use cosurf_wire::ModelHeader;

use super::record::{KeptOut, Moved};
use crate::gate::admit;
use crate::merge::{Locals, MergeError, MergeProgress, MergeSettings, Merged, merge};

/// Steps between two reports.
const TELL_EVERY: u32 = 50;

/// A merge under way. Dropping it gives it up.
#[derive(Debug)]
pub(super) struct Job {
    /// What is merged, in order of device id.
    pub(super) inputs: Vec<ModelHeader>,
    stop: Arc<AtomicBool>,
    progress: Receiver<MergeProgress>,
    thread: Option<JoinHandle<Result<Outcome, MergeError>>>,
}

/// What came of a merge.
pub(super) struct Outcome {
    /// `None` where nobody took part.
    pub(super) merged: Option<Merged>,
    /// Who took no part.
    pub(super) kept_out: Vec<KeptOut>,
    /// Who was moved.
    pub(super) moved: Vec<Moved>,
}

/// What a look at a merge finds.
pub(super) enum Look {
    /// Nothing new.
    Busy,
    /// It has come further.
    Further(MergeProgress),
    /// It is done.
    Done(Box<Result<Outcome, MergeError>>),
}

/// Models in a store.
struct Stored {
    models: ModelStore,
    headers: Vec<ModelHeader>,
}

impl Locals for Stored {
    fn count(&self) -> usize {
        self.headers.len()
    }

    fn load(&self, index: usize) -> Result<Model, MergeError> {
        let (_, body) = self.models.get(ModelKey::from(&self.headers[index]))?;
        Ok(body_to_model(&body)?)
    }
}

impl Job {
    pub(super) fn start(
        models: ModelStore,
        inputs: Vec<ModelHeader>,
        settings: MergeSettings,
        threads: usize,
    ) -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let (say, progress) = mpsc::channel();
        let (headers, flag) = (inputs.clone(), stop.clone());
        let thread = thread::spawn(move || {
            let is_stopped = || flag.load(Ordering::Relaxed);
            let names: Vec<String> = headers.iter().map(|header| header.device.to_string()).collect();
            let stored = Stored { models, headers };
            let admitted = admit(&stored, settings.refine, threads, &is_stopped)?;
            let kept_out = admitted.kept_out(&names);
            let kept_out = kept_out.map(|(i, reason)| KeptOut::new(&stored.headers[i], reason)).collect();
            let places = (0..admitted.count()).map(|place| admitted.place(place));
            let moved =
                places.filter_map(|(i, by)| Some(Moved { device: names[i].clone(), by: by? })).collect();
            if admitted.count() == 0 {
                return Ok(Outcome { merged: None, kept_out, moved });
            }
            let merged = merge(&admitted, &settings, threads, &mut |progress: MergeProgress| {
                if progress.step.is_multiple_of(TELL_EVERY) {
                    let _ = say.send(progress); // nobody listens any more where the job was given up
                }
                if is_stopped() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
            })?;
            Ok(Outcome { merged: Some(merged), kept_out, moved })
        });
        Self { inputs, stop, progress, thread: Some(thread) }
    }

    /// Looks how far it has come, without waiting. After [`Look::Done`] there is nothing more to see.
    pub(super) fn look(&mut self) -> Look {
        if let Ok(progress) = self.progress.try_recv() {
            return Look::Further(progress);
        }
        match self.thread.take_if(|thread| thread.is_finished()) {
            Some(thread) => Look::Done(Box::new(thread.join().unwrap_or(Err(MergeError::GivenUp)))),
            None => Look::Busy,
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
