//! A merge on a thread of its own.

use std::ops::ControlFlow;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, Receiver};
use std::thread::{self, JoinHandle};

use cosurf_link::{Model, ModelKey, ModelStore, body_to_model};
use cosurf_wire::ModelHeader;

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
    thread: Option<JoinHandle<Result<Merged, MergeError>>>,
}

/// What a look at a merge finds.
pub(super) enum Look {
    /// Nothing new.
    Busy,
    /// It has come further.
    Further(MergeProgress),
    /// It is done.
    Done(Result<Merged, MergeError>),
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
        let (stored, flag) = (Stored { models, headers: inputs.clone() }, stop.clone());
        let thread = thread::spawn(move || {
            merge(&stored, &settings, threads, &mut |progress: MergeProgress| {
                if progress.step.is_multiple_of(TELL_EVERY) {
                    let _ = say.send(progress); // nobody listens any more where the job was given up
                }
                if flag.load(Ordering::Relaxed) { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
            })
        });
        Self { inputs, stop, progress, thread: Some(thread) }
    }

    /// Looks how far it has come, without waiting. After [`Look::Done`] there is nothing more to see.
    pub(super) fn look(&mut self) -> Look {
        if let Ok(progress) = self.progress.try_recv() {
            return Look::Further(progress);
        }
        match self.thread.take_if(|thread| thread.is_finished()) {
            Some(thread) => Look::Done(thread.join().unwrap_or(Err(MergeError::GivenUp))),
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
