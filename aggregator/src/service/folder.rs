//! Files and folders in the folder of a service.

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsStr;
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use cosurf_link::{Model, ModelKey, ModelStore, body_to_model};
use cosurf_scene::{LocalFrame, SceneError, camera_list};
use cosurf_wire::{DeviceId, ModelHeader};

use super::error::ServiceError;
use crate::merge::concatenate;

/// Joins the newest models of all devices in the folders of services, without merging them. The result is in `frame`.
pub(crate) fn joined(folders: &[PathBuf], frame: &LocalFrame) -> Result<Model, ServiceError> {
    let mut parts = Vec::new();
    for folder in folders {
        let (models, headers) = ModelStore::open(&folder.join("models"))?;
        let newest: BTreeMap<DeviceId, ModelHeader> =
            headers.into_iter().map(|header| (header.device, header)).collect();
        for header in newest.values() {
            parts.push(body_to_model(&models.get(ModelKey::from(header))?.1, frame)?);
        }
    }
    Ok(concatenate(&parts))
}

/// Folder of the global model's revisions, inside the folder of a service.
pub(crate) fn global_store(folder: &Path) -> PathBuf {
    folder.join("global")
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

/// Devices of which the service with this folder has a model, or a part of one. Reads only the names of files, so the
/// service may be running.
pub fn senders(folder: &Path) -> Result<BTreeSet<DeviceId>, SceneError> {
    let mut senders = BTreeSet::new();
    for store in ["models", "parts"].map(|name| folder.join(name)) {
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
