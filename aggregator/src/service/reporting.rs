//! Reports: what is made of each revision for people, on a thread of its own. A report takes as much memory as a merge, so
//! none is made while models are merged, and a merge that is due ends it.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use cosurf_scene::SceneError;
use cosurf_wire::{ModelId, SiteId};

use super::event::ServiceEvent;

/// Pause before a report that failed is made again.
const RETRY: Duration = Duration::from_secs(60);

/// Makes the report of the newest revision in a service's folder: `mesh.ply`, `report.json` and `report.html`.
pub type Reporter = fn(&ReportTask) -> Result<Reported, ReportError>;

/// What a [`Reporter`] is asked to do.
#[derive(Clone, Debug)]
pub struct ReportTask {
    /// The service's folder.
    pub folder: PathBuf,
    /// The site.
    pub site: SiteId,
    /// Limit on the memory, bytes.
    pub memory_bytes: u64,
    /// Threads to compute with, at least 1.
    pub threads: usize,
    stop: Arc<AtomicBool>,
}

impl ReportTask {
    /// A task that nobody stops yet.
    pub fn new(folder: PathBuf, site: SiteId, memory_bytes: u64, threads: usize) -> Self {
        Self { folder, site, memory_bytes, threads, stop: Arc::default() }
    }

    /// Whether the report shall end without a result, as soon as it can.
    pub fn is_stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }
}

/// A report that was made, or that was there already.
#[derive(Clone, Debug, PartialEq)]
pub struct Reported {
    /// The revision that it is of.
    pub revision: u64,
    /// Number of triangles of the mesh, if there is one.
    pub triangles: Option<usize>,
    /// Why there is no mesh.
    pub mesh_failure: Option<String>,
    /// False if it was there already.
    pub is_new: bool,
}

/// Why there is no report.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReportError {
    /// It was not wanted any more.
    #[error("the report was stopped")]
    Stopped,
    /// A file could not be read or written.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// A picture could not be encoded.
    #[error("a picture of the report: {0}")]
    Picture(#[from] image::ImageError),
    /// The figures could not be encoded.
    #[error("the figures of the report: {0}")]
    Figures(#[from] serde_json::Error),
    /// The reporter panicked.
    #[error("internal error while the report was made; please report it")]
    Panicked,
}

/// When reports are made, and the one that is being made.
#[derive(Debug)]
pub(super) struct Reporting {
    reporter: Reporter,
    task: ReportTask,
    /// The revision whose report is in the folder, or of which there is no model any more.
    reported: Option<ModelId>,
    running: Option<(ModelId, JoinHandle<Result<Reported, ReportError>>)>,
    retry_at: Duration,
}

impl Reporting {
    pub(super) fn new(reporter: Reporter, task: ReportTask) -> Self {
        Self { reporter, task, reported: None, running: None, retry_at: Duration::ZERO }
    }

    /// Makes the report of this revision, unless it is made already or another report is being made.
    pub(super) fn begin(&mut self, revision: ModelId, now: Duration) {
        if self.running.is_some() || self.reported == Some(revision) || now < self.retry_at {
            return;
        }
        self.task.stop = Arc::default();
        let (reporter, task) = (self.reporter, self.task.clone());
        self.running = Some((revision, thread::spawn(move || reporter(&task))));
    }

    /// Asks a running report to stop. Returns whether it is still running.
    pub(super) fn is_in_the_way(&mut self) -> bool {
        self.task.stop.store(true, Ordering::Relaxed);
        self.running.is_some()
    }

    /// Ends a running report, and waits until it has ended.
    pub(super) fn end(&mut self) {
        self.task.stop.store(true, Ordering::Relaxed);
        if let Some((_, thread)) = self.running.take() {
            let _ = thread.join();
        }
    }

    /// The next report is made anew, because the merge has changed what it tells.
    pub(super) fn outdate(&mut self) {
        self.reported = None;
    }

    /// The outcome of a report that has ended.
    pub(super) fn poll(&mut self, now: Duration) -> Option<ServiceEvent> {
        let (revision, thread) = self.running.take_if(|(_, thread)| thread.is_finished())?;
        match thread.join().unwrap_or(Err(ReportError::Panicked)) {
            Err(ReportError::Stopped) => {
                // It stopped by itself if there is no model any more.
                self.reported = (!self.task.is_stopped()).then_some(revision).or(self.reported);
                None
            }
            Err(error) => {
                self.retry_at = now + RETRY;
                let reason = format!("there is no report of revision {revision}: {error}");
                Some(ServiceEvent::DiskFailed { reason })
            }
            Ok(Reported { revision: of, triangles, mesh_failure, is_new }) => {
                self.reported = Some(revision);
                is_new.then_some(ServiceEvent::Reported { revision: of, triangles, mesh_failure })
            }
        }
    }
}

impl Drop for Reporting {
    fn drop(&mut self) {
        self.end();
    }
}
