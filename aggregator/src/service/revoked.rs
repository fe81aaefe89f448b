//! Devices that the operator has revoked: nothing that comes under their names counts, whoever has signed it. A file for
//! each device, so the list outlasts a restart, and a command changes it while the service runs.
//!
//! What it knows nothing about: keys and certificates. Who has stolen a device's key can use it under no other name.

use std::collections::BTreeSet;
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use cosurf_scene::{SceneError, atomic, files};
use cosurf_wire::DeviceId;

use super::record::remove;

/// The folder with the files, inside the folder of the service.
const REVOKED: &str = "revoked";
/// Content of the files, for people who find them.
const CONTENT: &[u8] = b"revoked by the operator; `cosurf-aggregator revoke --undo` removes this file\n";

/// Revokes a device of the service with this folder, whether the service is running or not. Its messages do not count any
/// more; its models do until it is forgotten.
pub fn revoke(folder: &Path, device: &DeviceId) -> Result<(), SceneError> {
    let folder = list_in(folder)?;
    files::create_folder(&folder)?;
    atomic::write_bytes(&folder.join(device.as_str()), CONTENT)
}

/// The folder with the files, which may be missing.
fn list_in(folder: &Path) -> Result<PathBuf, SceneError> {
    let folder = folder.join(REVOKED);
    if folder.exists() && !folder.is_dir() {
        return Err(SceneError::malformed(&folder, "is no folder; remove it, and revoke devices again"));
    }
    Ok(folder)
}

/// Lets a revoked device take part again. Returns false if it was not revoked.
pub fn readmit(folder: &Path, device: &DeviceId) -> Result<bool, SceneError> {
    remove(&folder.join(REVOKED).join(device.as_str()))
}

/// The revoked devices of the service with this folder.
pub fn revoked(folder: &Path) -> Result<BTreeSet<DeviceId>, SceneError> {
    let folder = list_in(folder)?;
    let failed = |cause| SceneError::io(&folder, cause);
    let entries = match fs::read_dir(&folder) {
        Err(cause) if cause.kind() == ErrorKind::NotFound => return Ok(BTreeSet::new()),
        entries => entries.map_err(failed)?,
    };
    let mut devices = BTreeSet::new();
    for entry in entries {
        devices.extend(entry.map_err(failed)?.file_name().to_str().and_then(|name| DeviceId::new(name).ok()));
    }
    Ok(devices)
}
