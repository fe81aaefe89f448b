//! Models on a disk: one file each, written, synced and renamed before anyone is told.

use std::path::{Path, PathBuf};

use cosurf_wire::ModelHeader;

use crate::ModelKey;

/// What the disk did.
#[derive(Debug, thiserror::Error)]
#[error("{path}: {source}")]
pub struct StoreError {
    /// The file or folder.
    pub path: PathBuf,
    /// What the operating system said.
    pub source: std::io::Error,
}

/// A folder of models.
#[derive(Debug)]
pub struct ModelStore {}

impl ModelStore {
    /// Opens or makes the folder and reads the headers of the models in it; unfinished and damaged
    /// files are left out.
    pub fn open(_folder: &Path) -> Result<(Self, Vec<ModelHeader>), StoreError> {
        unimplemented!("lands soon")
    }

    /// Writes a model; when it returns, it survives a power loss.
    pub fn put(&self, _header: &ModelHeader, _body: &[u8]) -> Result<(), StoreError> {
        unimplemented!("lands soon")
    }

    /// Reads a model back; its hash has been checked.
    pub fn get(&self, _key: ModelKey) -> Result<(ModelHeader, Vec<u8>), StoreError> {
        unimplemented!("lands soon")
    }
}
