//! Stages of COLMAP's work in a folder. A stage that is finished leaves a stamp, and is not done again while its input and
//! its options stay the same. A stage that was killed begins again.

use std::ffi::OsString;
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::time::Instant;

use cosurf_contract::{AgentEvent, IngestStage};
use cosurf_scene::{SceneError, atomic, files};

use super::colmap::{Colmap, Progress};
use super::error::IngestError;

/// The stages of COLMAP, in their order.
const ORDER: [IngestStage; 4] =
    [IngestStage::Features, IngestStage::Matches, IngestStage::Poses, IngestStage::Undistorting];

/// A stage: commands of COLMAP.
pub(super) struct Stage {
    pub(super) kind: IngestStage,
    /// The commands, each with the number of photographs that it works on.
    pub(super) commands: Vec<(Vec<OsString>, usize)>,
    /// Files that they read and that no earlier stage has made: what these hold decides whether the stage is done again.
    pub(super) inputs: Vec<PathBuf>,
    /// Files and folders that a killed or an earlier run may have left, which go before the stage begins.
    pub(super) removed: Vec<PathBuf>,
    /// Folders that the commands write to.
    pub(super) folders: Vec<PathBuf>,
}

/// The folder that COLMAP works in.
pub(super) struct Stages<'a> {
    colmap: &'a Colmap,
    folder: PathBuf,
    /// Hash of all that the stages so far were made from.
    key: blake3::Hash,
    tell: &'a mut dyn FnMut(AgentEvent),
}

impl<'a> Stages<'a> {
    /// Stages whose first input has this hash.
    pub(super) fn new(
        colmap: &'a Colmap,
        folder: &Path,
        key: blake3::Hash,
        tell: &'a mut dyn FnMut(AgentEvent),
    ) -> Self {
        Self { colmap, folder: folder.to_owned(), key, tell }
    }

    /// The log of a stage.
    pub(super) fn log(&self, kind: IngestStage) -> PathBuf {
        self.folder.join(format!("{}.log", name(kind)))
    }

    /// Tells what happens between stages.
    pub(super) fn tell(&mut self, event: AgentEvent) {
        (self.tell)(event);
    }

    /// Does a stage, unless an earlier run has finished it with the same input and the same options.
    pub(super) fn run(&mut self, stage: &Stage) -> Result<(), IngestError> {
        self.key = key_of(&self.key, stage)?;
        let of = stage.commands.iter().map(|(_, photographs)| photographs).sum();
        let stamp_of = |kind| self.folder.join(format!("{}.stamp", name(kind)));
        let stamp = stamp_of(stage.kind);
        let key = self.key.to_hex();
        if fs::read(&stamp).is_ok_and(|stamp| stamp == key.as_bytes()) {
            let done = of;
            (self.tell)(AgentEvent::Ingesting {
                stage: stage.kind,
                done,
                of,
                seconds_left: None,
                resumed: true,
            });
            return Ok(());
        }
        let log = self.log(stage.kind);
        // What later stages made, they made from what goes now.
        ORDER.iter().skip_while(|kind| **kind != stage.kind).try_for_each(|kind| remove(&stamp_of(*kind)))?;
        stage.removed.iter().chain([&log]).try_for_each(|path| remove(path))?;
        for path in &stage.folders {
            files::create_folder(path)?;
        }
        self.work(stage, of, &log)?;
        Ok(atomic::write_bytes(&stamp, key.as_bytes())?)
    }

    /// Makes the next run do a stage again.
    pub(super) fn forget(&self, kind: IngestStage) -> Result<(), IngestError> {
        remove(&self.folder.join(format!("{}.stamp", name(kind))))
    }

    fn work(&mut self, stage: &Stage, of: usize, log: &Path) -> Result<(), IngestError> {
        let begun = Instant::now();
        let tell = &mut *self.tell;
        let mut last = None;
        let mut at = |done: usize| {
            let done = done.min(of);
            if last.replace(done) == Some(done) {
                return;
            }
            let left = begun.elapsed().as_secs_f32() / done.max(1) as f32 * (of - done) as f32;
            let seconds_left = (done > 0).then_some(left);
            tell(AgentEvent::Ingesting { stage: stage.kind, done, of, seconds_left, resumed: false });
        };
        at(0);
        let mut before = 0;
        for (command, photographs) in &stage.commands {
            self.colmap.run(command, log, &mut |Progress { done, of }| {
                // Commands count photographs or blocks of pairs.
                at(before + of.map_or(done, |of| done * photographs / of.max(1)));
            })?;
            before += photographs;
        }
        at(of);
        Ok(())
    }
}

/// Name of the files of a stage.
fn name(kind: IngestStage) -> &'static str {
    match kind {
        IngestStage::Reading => "reading",
        IngestStage::Features => "features",
        IngestStage::Matches => "matches",
        IngestStage::Poses => "poses",
        IngestStage::Adjusting => "adjusting",
        IngestStage::Undistorting => "undistorting",
    }
}

fn key_of(before: &blake3::Hash, stage: &Stage) -> Result<blake3::Hash, IngestError> {
    let mut hasher = blake3::Hasher::new();
    hasher.update(before.as_bytes());
    for word in stage.commands.iter().flat_map(|(command, _)| command) {
        hasher.update(&(word.len() as u64).to_le_bytes());
        hasher.update(word.as_encoded_bytes());
    }
    for path in &stage.inputs {
        let read = File::open(path).and_then(|file| hasher.update_reader(file).map(|_| ()));
        read.map_err(|cause| SceneError::io(path, cause))?;
    }
    Ok(hasher.finalize())
}

/// Removes a file or a folder with all that it holds, if it is there.
pub(super) fn remove(path: &Path) -> Result<(), IngestError> {
    let removed = if path.is_dir() { fs::remove_dir_all(path) } else { fs::remove_file(path) };
    match removed {
        Err(cause) if cause.kind() != io::ErrorKind::NotFound => Err(SceneError::io(path, cause).into()),
        _ => Ok(()),
    }
}
