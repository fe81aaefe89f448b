//! Models on a disk, one file each: written, synced and renamed before anyone is told that they are there.
//!
//! A file `{device}.{model}.model` is the length of the header as `u16` little-endian, the header as it
//! was announced ([`cosurf_wire::Message`]), then the body.

use std::fs;
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

use cosurf_scene::{SceneError, atomic};
use cosurf_wire::{MAX_CONTROL_BYTES, Message, ModelHeader};

use crate::body::body_hash;
use crate::codec::check_body;
use crate::key::ModelKey;

const EXTENSION: &str = "model";

/// What is wrong with a model's file, or with the disk.
#[derive(Debug, thiserror::Error)]
#[error(transparent)]
pub struct StoreError(#[from] SceneError);

/// A folder of models.
#[derive(Clone, Debug)]
pub struct ModelStore {
    folder: PathBuf,
}

impl ModelStore {
    /// Opens or makes the folder and reads the headers of the models in it, ordered by device and number.
    /// What a killed process left unfinished is removed; a file that is no whole model is an error, named.
    pub fn open(folder: &Path) -> Result<(Self, Vec<ModelHeader>), StoreError> {
        let failed = |cause| SceneError::io(folder, cause);
        fs::create_dir_all(folder).map_err(failed)?;
        atomic::remove_partial_files(folder)?;
        let store = Self { folder: folder.to_owned() };
        let mut headers = Vec::new();
        for entry in fs::read_dir(folder).map_err(failed)? {
            let path = entry.map_err(failed)?.path();
            if path.extension().is_some_and(|extension| extension == EXTENSION) {
                headers.push(open_file(&path)?.1);
            }
        }
        headers.sort_by_key(|header| (header.device, header.model));
        Ok((store, headers))
    }

    /// Writes a model; when this returns, it survives a power cut.
    pub fn put(&self, header: &ModelHeader, body: &[u8]) -> Result<(), StoreError> {
        let key = ModelKey::from(header);
        let mut buffer = [0; MAX_CONTROL_BYTES];
        // A test of the wire holds every header to this size.
        let head = Message::Header(*header).encode(&mut buffer).expect("every header fits its largest size");
        atomic::write(&self.path(key), |out| {
            out.write_all(&(head.len() as u16).to_le_bytes())?;
            out.write_all(head)?;
            out.write_all(body)
        })?;
        Ok(())
    }

    /// Reads a model back; its hash and all its values have been checked.
    pub fn get(&self, key: ModelKey) -> Result<(ModelHeader, Vec<u8>), StoreError> {
        let path = self.path(key);
        let (mut file, header) = open_file(&path)?;
        let mut body = vec![0; header.body_bytes as usize];
        file.read_exact(&mut body).map_err(|cause| SceneError::io(&path, cause))?;
        if body_hash(&body) != header.blake3 {
            return Err(malformed(&path, "its bytes have changed").into());
        }
        check_body(&header, &body).map_err(|fault| malformed(&path, &fault.to_string()))?;
        Ok((header, body))
    }

    /// Forgets a model, if it is there.
    pub fn remove(&self, key: ModelKey) -> Result<(), StoreError> {
        let path = self.path(key);
        match fs::remove_file(&path) {
            Err(cause) if cause.kind() != io::ErrorKind::NotFound => Err(SceneError::io(&path, cause).into()),
            _ => Ok(()),
        }
    }

    fn path(&self, key: ModelKey) -> PathBuf {
        self.folder.join(format!("{}.{}.{EXTENSION}", key.device, key.model))
    }
}

/// Reads the header and holds the file's size against it; leaves the file at the start of the body.
fn open_file(path: &Path) -> Result<(fs::File, ModelHeader), SceneError> {
    let failed = |cause| SceneError::io(path, cause);
    let mut file = fs::File::open(path).map_err(failed)?;
    let mut length = [0; 2];
    file.read_exact(&mut length).map_err(failed)?;
    let length = u16::from_le_bytes(length);
    let mut buffer = [0; MAX_CONTROL_BYTES];
    let head =
        buffer.get_mut(..usize::from(length)).ok_or_else(|| malformed(path, "its header is too long"))?;
    file.read_exact(head).map_err(failed)?;
    let header = match Message::decode(head) {
        Ok(Message::Header(header)) => header,
        Ok(_) => return Err(malformed(path, "it does not begin with a header")),
        Err(error) => return Err(malformed(path, &error.to_string())),
    };
    let size = file.metadata().map_err(failed)?.len();
    if size != 2 + u64::from(length) + header.body_bytes {
        return Err(malformed(path, "its size is not what its header says"));
    }
    Ok((file, header))
}

fn malformed(path: &Path, what: &str) -> SceneError {
    SceneError::malformed(path, format!("{what}; delete it, its device will send it again"))
}
