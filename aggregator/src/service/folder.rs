//! Where things lie in the folder of a service.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use cosurf_link::{Model, ModelKey, ModelStore, body_to_model};
use cosurf_wire::{DeviceId, ModelHeader};

use super::error::ServiceError;
use crate::merge::concatenate;

/// Joins the newest model of each device in the folders of services, without merging.
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

/// Where a service with this folder keeps the revisions of its global model.
pub(crate) fn global_store(folder: &Path) -> PathBuf {
    folder.join("global")
}

/// Where a service with this folder keeps the newest global model for viewers.
pub fn global_ply(folder: &Path) -> PathBuf {
    folder.join("global.ply")
}
