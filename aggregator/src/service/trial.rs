//! Which model a merge was reading when the program died, so that a model that kills every merge is set aside.
//!
//! A power cut or an impatient owner may end a merge too. So the model is merged again after a death, and is set aside only
//! after several in a row. A merge that ends clears the models that took part in it.

use std::fs::{self, File};
use std::io::{ErrorKind, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use cosurf_scene::SceneError;
use cosurf_wire::ModelHeader;
use serde::{Deserialize, Serialize};

use super::checked;
use super::event::ServiceEvent;
use super::inputs::{Input, Inputs};

/// File of the models that merges died with, in the folder of a service.
pub(super) const SUSPECTS: &str = "suspects.json";
/// File that is there while a merge runs: the index of the model that it read last.
pub(super) const READING: &str = "reading";
/// Deaths in a row after which a model is set aside. With 2, a model was left out of one in seventy missions in which
/// programs were killed four times at random moments (`tests/tests/kills.rs`).
const DEATHS_MAX: u32 = 5;
/// The index while no model has been read.
const NONE: u32 = u32::MAX;

/// What is known about merges that did not end.
#[derive(Debug)]
pub(super) struct Trials {
    folder: PathBuf,
    record: Record,
}

/// The file [`SUSPECTS`].
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
struct Record {
    /// The models of the merge that runs, or ran last, in order.
    merging: Vec<Input>,
    /// Models that were being read when the program died.
    suspects: Vec<Suspect>,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Suspect {
    model: Input,
    deaths: u32,
}

impl Trials {
    /// Reads what an earlier run left. If it died in a merge, the model that was being read becomes a suspect, which the
    /// event tells.
    pub(super) fn open(folder: &Path) -> Result<(Self, Option<ServiceEvent>), SceneError> {
        let record = checked::read(&folder.join(SUSPECTS)).unwrap_or_default();
        let mut trials = Self { folder: folder.to_owned(), record };
        let Some(read) = read_index(&folder.join(READING)) else { return Ok((trials, None)) };
        let event = trials.record.merging.get(read as usize).cloned().map(|model| trials.suspect(model));
        trials.write()?;
        end(&folder.join(READING));
        Ok((trials, event))
    }

    fn suspect(&mut self, model: Input) -> ServiceEvent {
        let known = self.record.suspects.iter_mut().find(|suspect| suspect.model == model);
        let deaths = match known {
            Some(suspect) => {
                suspect.deaths += 1;
                suspect.deaths
            }
            None => {
                self.record.suspects.push(Suspect { model: model.clone(), deaths: 1 });
                1
            }
        };
        let is_set_aside = deaths >= DEATHS_MAX;
        let file = self.folder.join(SUSPECTS).display().to_string();
        ServiceEvent::MergeDied { device: model.device, model: model.model, is_set_aside, file }
    }

    /// The models without those that are set aside.
    pub(super) fn admit(&self, inputs: Inputs) -> Inputs {
        let Inputs { mut whole, mut parts } = inputs;
        whole.retain(|header| !self.is_set_aside(&Input::whole(header)));
        parts.retain(|header| !self.is_set_aside(&Input::part(header)));
        Inputs { whole, parts }
    }

    fn is_set_aside(&self, model: &Input) -> bool {
        let is_model = |suspect: &&Suspect| suspect.model == *model;
        self.record.suspects.iter().find(is_model).is_some_and(|suspect| suspect.deaths >= DEATHS_MAX)
    }

    /// Notes durably that these models are being merged.
    pub(super) fn begin(&mut self, inputs: &Inputs) -> Result<Watch, SceneError> {
        self.record.merging = models(inputs);
        self.write()?;
        let path = self.folder.join(READING);
        let file = File::create(&path).map_err(|cause| SceneError::io(&path, cause))?;
        let watch = Watch { path, file: Mutex::new(file), models: self.record.merging.clone() };
        watch.note(NONE).map_err(|cause| SceneError::io(&watch.path, cause))?;
        Ok(watch)
    }

    /// A merge of these models has ended: they kill no merge.
    pub(super) fn clear(&mut self, inputs: &Inputs) -> Result<(), SceneError> {
        let merged = models(inputs);
        let before = self.record.suspects.len();
        self.record.suspects.retain(|suspect| !merged.contains(&suspect.model));
        if self.record.suspects.len() < before { self.write() } else { Ok(()) }
    }

    fn write(&self) -> Result<(), SceneError> {
        checked::write(&self.folder.join(SUSPECTS), &self.record)
    }
}

/// The models of a merge, complete ones first.
fn models(inputs: &Inputs) -> Vec<Input> {
    inputs.whole.iter().map(Input::whole).chain(inputs.parts.iter().map(Input::part)).collect()
}

/// Notes what a running merge reads. Dropped when the merge has ended, however it ended; only if the program dies does the
/// note stay.
#[derive(Debug)]
pub(super) struct Watch {
    path: PathBuf,
    file: Mutex<File>,
    models: Vec<Input>,
}

impl Watch {
    /// Notes that the merge reads a model. The note survives the program, but not a power cut, which no model causes. If it
    /// cannot be written, the merge goes on without it.
    pub(super) fn reads(watch: Option<&Arc<Self>>, header: &ModelHeader) {
        let Some(watch) = watch else { return };
        let is_it = |input: &Input| input.model == header.model.0 && input.device == header.device.as_str();
        if let Some(index) = watch.models.iter().position(is_it) {
            let _ = watch.note(u32::try_from(index).unwrap_or(NONE));
        }
    }

    fn note(&self, index: u32) -> std::io::Result<()> {
        let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        file.seek(SeekFrom::Start(0))?;
        file.write_all(&index.to_le_bytes())
    }
}

impl Drop for Watch {
    fn drop(&mut self) {
        end(&self.path);
    }
}

/// Removes the note. If that fails, one death too many is counted, and a model is merged all the same.
fn end(path: &Path) {
    if let Err(error) = fs::remove_file(path)
        && error.kind() != ErrorKind::NotFound
    {
        tracing::warn!("{}: {error}", path.display());
    }
}

/// The index in the note; `None` if no merge was running.
fn read_index(path: &Path) -> Option<u32> {
    let mut bytes = [0; 4];
    match File::open(path).and_then(|mut file| file.read_exact(&mut bytes)) {
        Ok(()) => Some(u32::from_le_bytes(bytes)),
        Err(error) if error.kind() == ErrorKind::NotFound => None,
        Err(_) => Some(NONE),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_link::Offer;
    use cosurf_wire::{DeviceId, ModelId, ModelKind};

    use super::*;
    use crate::testing::ground;

    fn header(device: &str, number: u64) -> ModelHeader {
        let device = DeviceId::new(device).unwrap();
        Offer::new(device, ModelId(number), ModelKind::Local, 1, &ground(0.0, 1.0), &[]).unwrap().header
    }

    fn inputs(models: &[(&str, u64)]) -> Inputs {
        let whole = models.iter().map(|(device, number)| header(device, *number)).collect();
        Inputs { whole, parts: Vec::new() }
    }

    /// A merge that reads all models in turn, and the last one as the program dies.
    fn die(folder: &Path, models: &[(&str, u64)]) -> Option<ServiceEvent> {
        let (mut trials, event) = Trials::open(folder).unwrap();
        let inputs = trials.admit(inputs(models));
        let watch = Some(Arc::new(trials.begin(&inputs).unwrap()));
        inputs.whole.iter().for_each(|header| Watch::reads(watch.as_ref(), header));
        std::mem::forget(watch);
        event
    }

    fn is_aside(event: &ServiceEvent) -> bool {
        matches!(event, ServiceEvent::MergeDied { is_set_aside: true, .. })
    }

    #[test]
    fn a_model_is_set_aside_after_five_deaths_and_a_newer_one_is_not() {
        let folder = tempfile::tempdir().unwrap();
        let models = [("a", 1), ("b", 1)];
        assert_eq!(die(folder.path(), &models), None);
        for _ in 1..DEATHS_MAX {
            let event = die(folder.path(), &models).unwrap();
            assert!(!is_aside(&event) && event.to_string().contains("model 1 of b"), "{event}");
        }
        let (trials, event) = Trials::open(folder.path()).unwrap();
        assert!(is_aside(&event.unwrap()));
        assert_eq!(trials.admit(inputs(&models)), inputs(&[("a", 1)]));
        assert_eq!(trials.admit(inputs(&[("b", 2)])), inputs(&[("b", 2)]));
        // It stays aside, and is told only once.
        let (trials, event) = Trials::open(folder.path()).unwrap();
        assert_eq!((trials.admit(inputs(&models)), event), (inputs(&[("a", 1)]), None));
        // The remedy.
        fs::remove_file(folder.path().join(SUSPECTS)).unwrap();
        let (trials, _) = Trials::open(folder.path()).unwrap();
        assert_eq!(trials.admit(inputs(&models)), inputs(&models));
    }

    #[test]
    fn power_cuts_with_a_merge_in_between_set_nothing_aside() {
        let folder = tempfile::tempdir().unwrap();
        let models = [("a", 1), ("b", 1)];
        for _ in 1..DEATHS_MAX {
            die(folder.path(), &models);
        }
        let (mut trials, _) = Trials::open(folder.path()).unwrap();
        drop(trials.begin(&inputs(&models)).unwrap());
        trials.clear(&inputs(&models)).unwrap();
        assert_eq!(die(folder.path(), &models), None, "a merge that ended was no death");
        let (trials, event) = Trials::open(folder.path()).unwrap();
        assert!(!is_aside(&event.unwrap()));
        assert_eq!(trials.admit(inputs(&models)), inputs(&models));
    }
}
