//! Checkpoints: a file with the state of a training. A resumed training ends with the same bits as an uninterrupted one
//! on the same device. A training that has ended goes on from its checkpoint if more steps are asked for.
//!
//! The file starts with one line of JSON ([`Head`]). The rest is compressed with zstd: the trainer's numbers as
//! little-endian f32, then a BLAKE3 hash of these uncompressed numbers. The file is replaced atomically, so a kill at
//! any moment leaves the old or the new checkpoint, never a part of one.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use cosurf_contract::{CHECKPOINT, Curve};
use cosurf_engine::{AnyBackend, Backend, DeviceLost, Progress, Schedule, TrainSettings, Trainer};
use cosurf_scene::{Camera, SceneError, SparsePoint, atomic, files};
use serde::{Deserialize, Serialize};
use tracing::debug_span;

const FORMAT: &str = "cosurf checkpoint 5";
/// A fast compression level. The numbers hardly compress, and training waits until the file is written.
const ZSTD_LEVEL: i32 = 1;
/// Numbers of steps whose schedules tell whether two programs have the same rules for schedules.
const SCHEDULES: [u32; 3] = [300, 3_000, 30_000];
/// Limit on the first line; a file with a longer one is not a checkpoint.
const HEAD_BYTES_MAX: u64 = 4096;

/// Identifies a training, so that a checkpoint is restored only into the training that wrote it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Fingerprint(String);

impl Fingerprint {
    /// Hashes the settings except the number of steps, the cameras and the sparse points (positions and colours). The
    /// pictures' pixels are not hashed. Nor is the device, so a training can move to another device.
    pub fn of(settings: &TrainSettings, cameras: &[Camera], points: &[SparsePoint]) -> Self {
        let mut hash = blake3::Hasher::new();
        // So a program with another schedule does not go on with the training.
        hash.update(format!("{:?}", SCHEDULES.map(Schedule::new)).as_bytes());
        let settings = TrainSettings { schedule: Schedule::new(SCHEDULES[0]), ..*settings };
        // `Debug` prints every float with enough digits to tell it from any other float.
        hash.update(format!("{FORMAT} {settings:?}").as_bytes());
        for camera in cameras {
            hash.update(format!("{camera:?}").as_bytes());
        }
        for point in points {
            point.position.to_array().iter().for_each(|v| {
                hash.update(&v.to_le_bytes());
            });
            hash.update(&point.rgb);
        }
        Self(hash.finalize().to_hex().to_string())
    }
}

#[derive(Debug, Serialize, Deserialize)]
struct Head {
    format: String,
    fingerprint: Fingerprint,
    /// Number of steps of the whole training.
    steps: u32,
    steps_done: u32,
    splats: usize,
    splats_at_start: usize,
    #[serde(flatten)]
    spent: Spent,
    #[serde(default)]
    curve: Curve,
}

/// Time that a training has taken so far, summed over all runs of the program.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Spent {
    /// Elapsed time, seconds.
    pub seconds: f64,
    /// CPU time of all threads, seconds; 0 if the system does not report it.
    #[serde(default)]
    pub cpu_seconds: f64,
}

/// An open checkpoint file. Its first line has been read.
pub struct Checkpoint {
    path: PathBuf,
    head: Head,
    body: BufReader<File>,
}

/// The checkpoint is damaged, or no checkpoint of this version of the program.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct DamagedCheckpoint(String);

/// The checkpoint is whole, but this training cannot go on from it.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct OtherTraining(String);

/// Renames the checkpoint of the output folder `out`, so that it no longer counts. Returns its new path.
pub fn set_aside(out: &Path) -> Result<PathBuf> {
    Ok(files::set_aside(&path(out))?)
}

/// Makes the checkpoint's folder in the output folder `out`, unless it is there. Fails if no file may be created in it. Deletes
/// unfinished checkpoints of killed programs.
pub fn make_folder(out: &Path) -> Result<()> {
    let folder = out.join(CHECKPOINT);
    atomic::prepare_folder(&folder)?;
    Ok(atomic::remove_partial_files(&folder)?)
}

/// Path of the checkpoint file of a training whose output folder is `out`.
pub fn path(out: &Path) -> PathBuf {
    out.join(CHECKPOINT).join("state.bin")
}

impl Checkpoint {
    /// Opens the checkpoint in the output folder `out`. Returns `None` if there is no checkpoint. Fails with
    /// [`DamagedCheckpoint`] if it is no file, or its first line is not that of a checkpoint in this program's format.
    pub fn find(out: &Path) -> Result<Option<Self>> {
        let path = path(out);
        let file = match files::open(&path) {
            Ok(file) => file,
            Err(SceneError::Io { cause, .. }) if cause.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(error) if files::is_damage(&error) => return Err(DamagedCheckpoint(error.to_string()).into()),
            Err(error) => return Err(error.into()),
        };
        let mut body = BufReader::new(file);
        let mut line = Vec::new();
        body.by_ref()
            .take(HEAD_BYTES_MAX)
            .read_until(b'\n', &mut line)
            .with_context(|| path.display().to_string())?;
        let damaged = |what: String| DamagedCheckpoint(format!("{} {what}", path.display()));
        let head: Head = serde_json::from_slice(&line)
            .map_err(|_| damaged("is not a checkpoint of this program".into()))?;
        if head.format != FORMAT {
            return Err(damaged(format!("has the unknown format {:?}", head.format)).into());
        }
        Ok(Some(Self { path, head, body }))
    }

    /// The training curve up to this checkpoint.
    pub fn curve(&self) -> Curve {
        self.head.curve.clone()
    }

    /// Why a training cannot go on from this checkpoint, as the end of a sentence that begins with the checkpoint's path.
    /// `None` if it can.
    fn contradiction(&self, expected: &Fingerprint, trainer: &Trainer<AnyBackend>) -> Option<String> {
        let Head { ref fingerprint, steps, steps_done, splats, .. } = self.head;
        let wanted = trainer.settings().schedule.steps;
        if fingerprint != expected {
            Some("belongs to a training with other data or settings; start again with --fresh, or write to another folder".into())
        } else if steps > wanted {
            Some(format!(
                "belongs to a training of {steps} steps, which cannot have fewer; delete it to start again, or write to another \
                 folder"
            ))
        } else if steps < wanted && steps_done < steps {
            Some(format!(
                "belongs to a training of {steps} steps that has done {steps_done}: let it end with --steps {steps}, then ask for \
                 more"
            ))
        } else if splats > trainer.backend().capacity() {
            Some("has more splats than the memory allows; delete it to start again".into())
        } else {
            None
        }
    }

    /// Time that the training had taken when this checkpoint was written.
    pub fn spent(&self) -> Spent {
        self.head.spent
    }

    /// Restores the trainer to the state in the checkpoint. Fails with [`OtherTraining`] if the checkpoint belongs to another
    /// training, to one of more steps, or to one of fewer steps that has not ended, or if it has more splats than the
    /// trainer's memory allows. Fails with [`DamagedCheckpoint`] if it is damaged.
    pub fn restore(self, expected: &Fingerprint, trainer: &mut Trainer<AnyBackend>) -> Result<()> {
        let path = self.path.display().to_string();
        if let Some(why) = self.contradiction(expected, trainer) {
            return Err(OtherTraining(format!("{path} {why}")).into());
        }
        let truncated = |_| DamagedCheckpoint(format!("{path} is truncated"));
        let mut body = zstd::Decoder::new(self.body).map_err(truncated)?;
        let mut hash = blake3::Hasher::new();
        let mut bytes = Vec::new();
        let Head { steps_done, splats_at_start, splats, .. } = self.head;
        trainer
            .import(Progress { steps_done, splats_at_start, splats }, |numbers| -> io::Result<()> {
                bytes.resize(4 * numbers.len(), 0);
                body.read_exact(&mut bytes)?;
                hash.update(&bytes);
                for (number, bytes) in numbers.iter_mut().zip(bytes.chunks_exact(4)) {
                    *number = f32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]);
                }
                Ok(())
            })
            .map_err(truncated)?;
        let mut stored = [0; 32];
        body.read_exact(&mut stored).map_err(truncated)?;
        match hash.finalize() == stored {
            true => Ok(()),
            false => Err(DamagedCheckpoint(format!("{path} is damaged: its hash does not match")).into()),
        }
    }
}

/// Writes the checkpoint of `trainer` into the output folder `out`. `spent` is the time that the training has taken so
/// far, and `curve` its training curve. Fails with [`DeviceLost`] if the device was lost.
pub fn write(
    out: &Path,
    fingerprint: &Fingerprint,
    trainer: &Trainer<AnyBackend>,
    spent: Spent,
    curve: &Curve,
) -> Result<()> {
    let _span = debug_span!("checkpoint", step = trainer.steps_done()).entered();
    let path = path(out);
    if let Some(folder) = path.parent() {
        files::create_folder(folder)?;
    }
    let Progress { steps_done, splats_at_start, splats } = trainer.progress();
    let fingerprint = fingerprint.clone();
    let steps = trainer.settings().schedule.steps;
    let curve = curve.clone();
    let head =
        Head { format: FORMAT.into(), fingerprint, steps, steps_done, splats, splats_at_start, spent, curve };
    atomic::write(&path, |file| {
        serde_json::to_writer(&mut *file, &head)?;
        file.write_all(b"\n")?;
        let mut body = zstd::Encoder::new(file, ZSTD_LEVEL)?;
        let mut hash = blake3::Hasher::new();
        let mut bytes = Vec::new();
        trainer.export(|numbers| -> io::Result<()> {
            bytes.clear();
            bytes.extend(numbers.iter().flat_map(|number| number.to_le_bytes()));
            hash.update(&bytes);
            body.write_all(&bytes)
        })?;
        if let Some(reason) = trainer.backend().lost() {
            return Err(io::Error::other(reason));
        }
        body.write_all(hash.finalize().as_bytes())?;
        body.finish()?;
        Ok(())
    })
    .map_err(|error| match trainer.backend().lost() {
        Some(reason) => DeviceLost(reason).into(),
        None => error.into(),
    })
}
