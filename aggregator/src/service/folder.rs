//! Files and folders in the folder of a service.

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsStr;
use std::fs;
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};
use std::rc::Rc;
use std::time::UNIX_EPOCH;

use cosurf_link::{Model, ModelKey, ModelStore, body_to_model};
use cosurf_scene::{LocalFrame, SceneError, Splats, atomic, camera_list, ply};
use cosurf_wire::{DeviceId, ModelHeader, ModelId};

use super::error::ServiceError;
use crate::merge::concatenate;

/// Joins the newest models of all devices in the folders of services, without merging them, and writes them to `file`. One
/// model after the other is in memory.
pub(crate) fn write_joined(folders: &[PathBuf], file: &Path, frame: &LocalFrame) -> Result<(), ServiceError> {
    let mut parts = Vec::new();
    for folder in folders {
        let (store, headers) = ModelStore::open(&models(folder))?;
        let models = Rc::new(store);
        let newest: BTreeMap<DeviceId, ModelHeader> =
            headers.into_iter().map(|header| (header.device, header)).collect();
        parts.extend(newest.into_values().map(|header| (models.clone(), header)));
    }
    let count = parts.iter().map(|(_, header)| header.splats as usize).sum();
    let sh_degree = parts.iter().map(|(_, header)| u32::from(header.sh_degree)).max().unwrap_or(0);
    let wide = Model { splats: Splats::with_capacity(0, sh_degree), cameras: Vec::new() };
    let load = |(models, header): &(Rc<ModelStore>, ModelHeader)| {
        let body = models.get(ModelKey::from(header)).map_err(io::Error::other)?.1;
        let model = body_to_model(&body, frame).map_err(io::Error::other)?;
        // Pads lower degrees of spherical harmonics.
        Ok(concatenate(&[model, wide.clone()]).splats)
    };
    Ok(ply::write_parts(file, count, sh_degree, frame, parts.iter().map(load))?)
}

/// Folder of the global model's revisions, inside the folder of a service.
pub(crate) fn global_store(folder: &Path) -> PathBuf {
    folder.join("global")
}

/// Makes the folders in the folder of a service, unless they are there. Fails if something is in the way, or if no file may be
/// created in one of them.
pub(super) fn make_folders(folder: &Path) -> Result<(), SceneError> {
    let folders = [models, parts, global_store, tiles, sent_tiles, handed_on].map(|of| of(folder));
    folders.iter().try_for_each(|folder| atomic::prepare_folder(folder))
}

/// Folder of the parts of unfinished models, inside the folder of a service.
pub(super) fn parts(folder: &Path) -> PathBuf {
    folder.join("parts")
}

/// Folder of the local models, and of what has arrived of unfinished ones, inside the folder of a service.
pub(super) fn models(folder: &Path) -> PathBuf {
    folder.join("models")
}

/// Folder of the results of tiles, inside the folder of a service.
pub(super) fn tiles(folder: &Path) -> PathBuf {
    folder.join("tiles")
}

/// Folder of the tiles that devices get of a large global model, inside the folder of a service.
pub(super) fn sent_tiles(folder: &Path) -> PathBuf {
    folder.join("sent")
}

/// Folder of what devices get of the global model of the aggregator above, inside the folder of a service.
pub(super) fn handed_on(folder: &Path) -> PathBuf {
    folder.join("handed")
}

/// File of the newest global model for viewers, inside the folder of a service.
pub fn global_ply(folder: &Path) -> PathBuf {
    folder.join("global.ply")
}

/// Files of the newest global model that are made for viewers and other programs, inside the folder of a service: the
/// splats and the world cameras.
pub(super) const MADE_FILES: [&str; 2] = ["global.ply", camera_list::FILE];

/// Files that the report of a revision consists of, inside the folder of a service.
pub(super) const REPORT_FILES: [&str; 3] = ["mesh.ply", "report.html", "report.json"];

/// File of a device's model, inside the folder of a service; `None` if no device can have this name.
pub(super) fn model_file(folder: &Path, device: &str, model: u64) -> Option<PathBuf> {
    let key = ModelKey { device: DeviceId::new(device).ok()?, model: ModelId(model) };
    Some(ModelStore::beside(&models(folder)).path(key))
}

/// When a file was written, seconds since 1970; `None` if it is missing.
pub(super) fn written_s(path: &Path) -> Option<u64> {
    let modified = fs::metadata(path).and_then(|known| known.modified()).ok()?;
    Some(modified.duration_since(UNIX_EPOCH).ok()?.as_secs())
}

/// Devices of which the service with this folder has a model, or a part of one. Reads only the names of files, so the
/// service may be running.
pub fn senders(folder: &Path) -> Result<BTreeSet<DeviceId>, SceneError> {
    let mut senders = BTreeSet::new();
    for store in [models(folder), folder.join("parts")] {
        let entries = match fs::read_dir(&store) {
            Err(cause) if cause.kind() == ErrorKind::NotFound => continue,
            entries => entries.map_err(|cause| SceneError::io(&store, cause))?,
        };
        senders.extend(entries.flatten().filter_map(|entry| sender(&entry.file_name())));
    }
    Ok(senders)
}

/// The device of a file in a [`ModelStore`], whose name is `{device}.{number}.model`.
fn sender(file: &OsStr) -> Option<DeviceId> {
    let (device, _) = file.to_str()?.strip_suffix(".model")?.split_once('.')?;
    DeviceId::new(device).ok()
}
