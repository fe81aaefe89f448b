//! Small files beside the models: what the newest revision was merged from, and which devices are withdrawn.

use std::collections::BTreeMap;
use std::fmt;
use std::fs;
use std::io;
use std::path::Path;

use cosurf_scene::{LocalFrame, SceneError, files};
use cosurf_wire::{DeviceId, ModelHeader};
use serde::{Deserialize, Serialize};

use super::checked;
use super::folder::{MADE_FILES, REPORT_FILES, model_file, written_s};
use super::inputs::Input;
use super::model_list::ModelList;
use crate::gate::{Admitted, Fit, Place, Similarity, Tone};
use crate::merge::{LocalSummary, Locals, MergeSettings, MergeSummary};

pub(super) const MERGED: &str = "merged.json";
pub(super) const WITHDRAWN: &str = "withdrawn";

/// How the newest revision was merged: the content of `merged.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Merging {
    /// Number of the revision.
    pub revision: u64,
    /// BLAKE3 hashes of `global.ply` and `cameras.json`, by their names; none in folders of older versions.
    #[serde(default)]
    pub files_blake3: BTreeMap<String, String>,
    /// The models that the service gave to the merge, in order of device id.
    pub inputs: Vec<Input>,
    /// Those of `inputs` that were kept out of the merge.
    #[serde(default)]
    pub kept_out: Vec<KeptOut>,
    /// Those of `inputs` that took part otherwise than as they are: moved, with other colours, with less weight, or
    /// unverified.
    #[serde(default)]
    pub fitted: Vec<Fitted>,
    /// How well every two of `inputs` that share ground fit each other.
    #[serde(default)]
    pub fits: Vec<FitRecord>,
    /// Settings of the merge.
    pub settings: MergeSettings,
    /// Figures of the merge. Its `locals` are the models that took part, in order of device id.
    pub summary: MergeSummary,
    /// Duration of the merge, seconds.
    pub seconds: f64,
    /// The older revision that the operator has put in the place of the newest one; absent if the revision was merged. It
    /// stays until the operator asks for a merge.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub restored_from: Option<u64>,
}

/// A model that was kept out of a merge, and why.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct KeptOut {
    /// The device that sent the model.
    pub device: String,
    /// Number of the model.
    pub model: u64,
    /// The reason, as a sentence without its subject.
    pub reason: String,
}

impl fmt::Display for KeptOut {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "model {} of {} {}", self.model, self.device, self.reason)
    }
}

impl KeptOut {
    pub(super) fn new(header: &ModelHeader, reason: String) -> Self {
        Self { device: header.device.to_string(), model: header.model.0, reason }
    }
}

/// What the gate decided about the models of a merge.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Verdict {
    pub(super) kept_out: Vec<KeptOut>,
    pub(super) fitted: Vec<Fitted>,
    pub(super) fits: Vec<FitRecord>,
}

impl Verdict {
    /// `headers` are those of the models that were judged, in their order, and `frame` the frame that they were judged in.
    pub(super) fn of(admitted: &Admitted, headers: &[ModelHeader], frame: &LocalFrame) -> Self {
        let names: Vec<String> = headers.iter().map(|header| header.device.to_string()).collect();
        let kept_out =
            admitted.kept_out(&names).map(|(i, reason)| KeptOut::new(&headers[i], reason)).collect();
        let places = (0..admitted.count()).map(|place| admitted.place(place));
        let fitted = places.filter_map(|place| Fitted::of(&names[place.local], place, frame)).collect();
        let fits = admitted.fits().iter().map(|fit| FitRecord::of(&names, fit)).collect();
        Self { kept_out, fitted, fits }
    }

    /// Adds models that were kept out, in the order of devices.
    pub(super) fn keep_out(&mut self, more: Vec<KeptOut>) {
        self.kept_out.extend(more);
        self.kept_out.sort_by(|a, b| a.device.cmp(&b.device));
    }
}

/// How well the models of two devices show the same ground at the same place; see [`Fit`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FitRecord {
    /// The devices that sent the models.
    pub devices: [String; 2],
    /// Number of points of the ground that were found in both models.
    pub points: usize,
    /// Median distance between a point in one model and the same point in the other, before any model was moved, px of
    /// the compared pictures. Their long side is 320 px, or less if the models' own pictures are smaller.
    pub before_px: f64,
    /// The same after the models were moved.
    pub after_px: f64,
}

impl FitRecord {
    /// `names` has the name of every device that sent a model, by the index of the model.
    pub fn of(names: &[String], fit: &Fit) -> Self {
        let Fit { models, points, before_px, after_px } = *fit;
        Self { devices: models.map(|i| names[i].clone()), points, before_px, after_px }
    }
}

/// A model that was changed to fit the others, or about which there is something to tell.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Fitted {
    /// The device that sent the model.
    pub device: String,
    /// Transformation of the world that moves the model to where the others are; `None` if the model was not moved.
    pub by: Option<Similarity>,
    /// How far the ground that the model shares with others was moved: root mean square, world units; `None` if the
    /// model was not moved, and in records of version 0.1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub distance_m: Option<f64>,
    /// Change of the model's colours that matches them to those of the others; `None` if they were not changed.
    pub tone: Option<Tone>,
    /// What the model's observations count, 0..=1, if it differs from the others far more than they do; see
    /// [`Place::trust`]. `None` if they count fully.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub weight: Option<f64>,
    /// Factor on the sides of the model's pictures, 0..=1, if these show less detail than they claim; see
    /// [`Place::size`]. `None` if they keep their sizes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub size: Option<f64>,
    /// Share of the pictures of the model's own cameras that show hardly any ground, 0..=1; such cameras do not count.
    /// `None` if all show some.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub void: Option<f64>,
    /// True if the model shares no ground with the others. It takes part because its frame is vouched for.
    #[serde(default, skip_serializing_if = "is_false")]
    pub unverified: bool,
}

fn is_false(value: &bool) -> bool {
    !value
}

impl Fitted {
    /// `None` if there is nothing to tell. `frame` is that of the place.
    pub fn of(device: &str, place: Place, frame: &LocalFrame) -> Option<Self> {
        let Place { by, tone, trust, size, is_verified, void, .. } = place;
        let weight = trust.weight;
        let fitted = Self {
            device: device.to_string(),
            by: by.map(|by| by.by.world_from_frame(frame)),
            distance_m: by.map(|by| by.distance_m * frame.unit()),
            tone,
            weight: (weight < 1.0).then_some(weight),
            size: (size < 1.0).then_some(size),
            void: (void > 0.0).then_some(void),
            unverified: !is_verified,
        };
        let is_told = fitted.by.is_some()
            || tone.is_some()
            || weight < 1.0
            || size < 1.0
            || void > 0.0
            || fitted.unverified;
        is_told.then_some(fitted)
    }
}

impl fmt::Display for Fitted {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let moved = self.distance_m.map(|off| format!("lay {off:.2} m off and was moved to where it fits"));
        let weight = self.weight.map(|weight| {
            format!(
                "differs from the others far more than they do, so its views count only {:.0} %",
                100.0 * weight
            )
        });
        let unverified =
            self.unverified.then(|| "shares no ground with the others, so its place is unverified".into());
        let tone = self.tone.map(|tone| tone.to_string());
        let size = self.size.map(|size| {
            format!("shows no more detail than pictures {:.0} % as large, and counts as such", 100.0 * size)
        });
        let void = self.void.map(|void| {
            format!(
                "shows no ground in {:.0} % of the pictures of its own cameras, which do not count",
                100.0 * void
            )
        });
        let told: Vec<String> = [moved, tone, weight, size, void, unverified].into_iter().flatten().collect();
        write!(f, "{}: {}", self.device, told.join(", "))
    }
}

impl Merging {
    /// Reads the record in a service's folder. `None` if it is missing, damaged, or this version cannot read it; the service then
    /// merges the models again.
    pub fn read(folder: &Path) -> Option<Self> {
        checked::read(&folder.join(MERGED)).ok()
    }

    /// The models that arrived whole or in part, each with the figures of its merge; `None` for one that was kept out, or of
    /// which only a part had arrived.
    pub(crate) fn locals(&self) -> impl Iterator<Item = (&Input, Option<&LocalSummary>)> {
        let mut locals = self.summary.locals.iter();
        self.inputs.iter().map(move |input| {
            let takes_part = input.part_splats.is_none() && !self.is_kept_out(input);
            (input, if takes_part { locals.next() } else { None })
        })
    }

    /// The models that took part whole. `folder` is that of the service.
    pub(crate) fn contributions(&self, folder: &Path) -> Vec<Contribution> {
        let contribution = |(input, local): (&Input, Option<&LocalSummary>)| {
            let arrived_s = model_file(folder, &input.device, input.model).and_then(|file| written_s(&file));
            Some(Contribution { device: input.device.clone(), cameras: local?.cameras, arrived_s })
        };
        self.locals().filter_map(contribution).collect()
    }

    /// Whether the model was kept out of the merge.
    pub(crate) fn is_kept_out(&self, input: &Input) -> bool {
        self.kept_out.iter().any(|its| its.device == input.device && its.model == input.model)
    }

    pub(super) fn write(&self, folder: &Path) -> Result<(), SceneError> {
        checked::write(&folder.join(MERGED), self)
    }
}

/// A device whose model took part in a merge.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Contribution {
    /// The device.
    pub device: String,
    /// Number of its cameras. Those of the merged model are the cameras of all its devices, in their order.
    pub cameras: usize,
    /// When its model arrived, as the date of the model's file tells: seconds since 1970; `None` if the file is gone.
    pub arrived_s: Option<u64>,
}

/// What the newest revision of the service with this folder was merged from. Empty if that is not known.
pub fn contributions(folder: &Path) -> Vec<Contribution> {
    Merging::read(folder).map_or_else(Vec::new, |merging| merging.contributions(folder))
}

/// BLAKE3 hash of a file.
pub(crate) fn file_hash(path: &Path) -> Result<String, SceneError> {
    let mut hasher = blake3::Hasher::new();
    hasher.update_reader(files::open(path)?).map_err(|cause| SceneError::io(path, cause))?;
    Ok(hasher.finalize().to_hex().to_string())
}

/// Removes the newest global model of a service and the record of its merge. Returns false if there was neither.
pub(super) fn remove_global(folder: &Path) -> Result<bool, SceneError> {
    let mut had_any = false;
    for name in MADE_FILES.into_iter().chain(REPORT_FILES).chain([MERGED]) {
        had_any |= remove(&folder.join(name))?;
    }
    Ok(had_any)
}

/// Removes a file. Returns false if it does not exist.
pub(crate) fn remove(path: &Path) -> Result<bool, SceneError> {
    match fs::remove_file(path) {
        Ok(()) => Ok(true),
        Err(cause) if cause.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(cause) => Err(SceneError::io(path, cause)),
    }
}

/// The devices that were ever withdrawn from the service with this folder. Models that have arrived later count.
pub(crate) fn withdrawn(folder: &Path) -> Result<Vec<DeviceId>, SceneError> {
    Ok(ModelList::read_all(&folder.join(WITHDRAWN))?.into_keys().collect())
}

/// Withdraws a device from the service with this folder, whether the service is running or not. Models that have
/// arrived from the device no longer count; later ones do.
pub fn withdraw(folder: &Path, device: &DeviceId) -> Result<(), SceneError> {
    let folder = folder.join(WITHDRAWN);
    // The service adds the models that it has.
    let mut list = ModelList::read(&folder, device);
    list.asks = true;
    list.write(&folder, device)
}
