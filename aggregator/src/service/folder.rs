//! Files and folders in the folder of a service.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use cosurf_link::{Model, ModelKey, ModelStore, body_to_model};
use cosurf_wire::{DeviceId, ModelHeader};

use super::error::ServiceError;
use crate::merge::concatenate;

/// Joins the newest models of all devices in the folders of services, without merging them.
pub(crate) fn joined(folders: &[PathBuf]) -> Result<Model, ServiceError> {
    let mut parts = Vec::new();
    for folder in folders {
        let (models, headers) = ModelStore::open(&folder.join("models"))?;
        let newest: BTreeMap<DeviceId, ModelHeader> =
            headers.into_iter().map(|header| (header.device, header)).collect();
        for header in newest.values() {
            parts.push(body_to_model(&models.get(ModelKey::from(header))?.1)?);
        }
    }
    Ok(concatenate(&parts))
}

/// Folder of the global model's revisions, inside the folder of a service.
pub(crate) fn global_store(folder: &Path) -> PathBuf {
    folder.join("global")
}

/// File of the newest global model for viewers, inside the folder of a service.
pub fn global_ply(folder: &Path) -> PathBuf {
    folder.join("global.ply")
}
