//! The folder that `run --watch` watches, and the note of its last flight in the output folder.

use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use cosurf_agent::arrival::{Arrival, Content, Flight, Snapshot, Watch};
use cosurf_agent::ingest::{IngestPlan, ingest};
use cosurf_agent::{checkpoint, outputs};
use cosurf_geo::Geodetic;
use cosurf_scene::files;

use crate::cli::progress::Progress;

/// Time between two looks into the folder.
const LOOK_EVERY: Duration = Duration::from_secs(2);
/// Long side of the pictures that are made of photographs, pixels, unless the configuration tells another one; that of
/// `ingest`.
const INGEST_SIZE_PX: u32 = 1920;

/// A flight that could not be trained on.
pub(super) struct FailedFlight {
    pub(super) flight: Flight,
    /// Why, in one line.
    pub(super) reason: String,
}

/// A folder that is watched.
pub(super) struct Watched {
    folder: PathBuf,
    out: PathBuf,
}

impl Watched {
    /// Watches `folder` for the agent that writes to `out`.
    pub(super) fn open(folder: &Path, out: &Path) -> Result<Self> {
        let is_within = match (folder.canonicalize(), out.canonicalize()) {
            (Ok(folder), Ok(out)) => out.starts_with(folder),
            _ => false,
        };
        ensure!(
            !is_within,
            "--watch {}: the agent writes into this folder; set `out` to one outside of it",
            folder.display()
        );
        Ok(Self { folder: folder.to_owned(), out: out.to_owned() })
    }

    pub(super) fn folder(&self) -> &Path {
        &self.folder
    }

    /// Waits until a flight that is not done is complete. `failed` counts as done: it would fail again.
    pub(super) fn wait(&self, failed: Option<&FailedFlight>) -> Result<Arrival> {
        let noted = || serde_json::from_slice::<Flight>(&files::read(&self.note()).ok()?).ok();
        let last = failed.map(|failed| failed.flight.clone().done()).or_else(noted);
        let (mut watch, begun) = (Watch::after(last), Instant::now());
        loop {
            let snapshot = Snapshot::of(&self.folder);
            let snapshot = snapshot.with_context(|| format!("--watch {}", self.folder.display()))?;
            if let Some(arrival) = watch.observe(snapshot, begun.elapsed()) {
                return Ok(arrival);
            }
            thread::sleep(LOOK_EVERY);
        }
    }

    /// Begins with a flight, or goes on with it. Returns the folder of its dataset, which it makes of photographs.
    pub(super) fn begin(
        &self,
        arrival: &Arrival,
        origin: Option<Geodetic>,
        max_size_px: Option<u32>,
        progress: &mut Progress,
    ) -> Result<PathBuf> {
        let dataset = self.out.join("dataset");
        if !arrival.is_begun {
            // Before the note: a restart must not go on with what belongs to an earlier flight.
            remove(fs::remove_file(checkpoint::path(&self.out)), &self.out)?;
            remove(fs::remove_dir_all(&dataset), &dataset)?;
        }
        outputs::write_json(&self.note(), &arrival.flight)?;
        if arrival.content == Content::Dataset {
            return Ok(self.folder.clone());
        }
        let plan = IngestPlan {
            photographs: self.folder.clone(),
            out: dataset.clone(),
            colmap: "colmap".into(),
            origin,
            geoid: None,
            max_size_px: max_size_px.unwrap_or(INGEST_SIZE_PX),
        };
        ingest(&plan, &mut |event| progress.ingesting(&event))?;
        Ok(dataset)
    }

    /// Notes that the model of a flight is delivered.
    pub(super) fn finish(&self, arrival: Arrival) -> Result<()> {
        outputs::write_json(&self.note(), &arrival.flight.done())
    }

    fn note(&self) -> PathBuf {
        self.out.join("flight.json")
    }
}

/// What is not there need not be removed.
fn remove(removed: std::io::Result<()>, path: &Path) -> Result<()> {
    match removed {
        Err(error) if error.kind() != ErrorKind::NotFound => Err(error).context(path.display().to_string()),
        _ => Ok(()),
    }
}
