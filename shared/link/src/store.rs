//! Models on disk, one file each. A model counts as stored once its file is written, synced and renamed.
//!
//! A file `{device}.{model}.model` holds the length of the header (`u16`, little-endian), the header as it
//! was received (an encoded [`cosurf_wire::Message`]), and the body.

use std::fmt;
use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

use cosurf_scene::{Camera, LocalFrame, SceneError, atomic, files};
use cosurf_wire::{MAX_CONTROL_BYTES, Message, ModelHeader, ModelId};

use crate::body::body_hash;
use crate::codec::{body_cameras, check_body};
use crate::key::ModelKey;

const EXTENSION: &str = "model";
/// How much of a body is read for its cameras, bytes: head, table and cameras come first.
const CAMERAS_BYTES_MAX: u64 = 2 << 20;
const WRONG_HASH: &str = "its hash does not match";
const WRONG_NAME: &str = "it holds another model than its name says";

/// An invalid model file, or an I/O error.
#[derive(Debug, thiserror::Error)]
#[error(transparent)]
pub struct StoreError(#[from] SceneError);

/// A file in a folder of models that could not be used when the folder was opened. It was renamed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Damaged {
    /// The model, by the name of the file; `None` if the name is not that of a model.
    pub key: Option<ModelKey>,
    /// The path that the file has now.
    pub kept: PathBuf,
    /// What is wrong, one line that begins with the old path.
    pub reason: String,
}

impl fmt::Display for Damaged {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { kept, reason, .. } = self;
        write!(f, "{reason}; it is set aside as {}, which may be deleted", kept.display())
    }
}

/// A folder of models.
#[derive(Clone, Debug)]
pub struct ModelStore {
    folder: PathBuf,
}

impl ModelStore {
    /// Opens or creates the folder, and returns the headers of its models, ordered by device and number.
    /// Deletes partial files that a killed process has left behind. Files that cannot be used are set aside, as
    /// [`Self::open_telling`] does; the log tells them.
    pub fn open(folder: &Path) -> Result<(Self, Vec<ModelHeader>), StoreError> {
        Self::open_telling(folder, |damaged| tracing::warn!("{damaged}"))
    }

    /// Like [`Self::open`]. `tell` gets each file that is damaged, that holds another model than its name says, that is no
    /// file at all, or that cannot be read. Such a file was renamed, and its model counts as missing. Reads every file to
    /// check its hash.
    pub fn open_telling(
        folder: &Path,
        mut tell: impl FnMut(Damaged),
    ) -> Result<(Self, Vec<ModelHeader>), StoreError> {
        let failed = |cause| SceneError::io(folder, cause);
        files::create_folder(folder)?;
        atomic::remove_partial_files(folder)?;
        let store = Self { folder: folder.to_owned() };
        let mut headers = Vec::new();
        for entry in fs::read_dir(folder).map_err(failed)? {
            let path = entry.map_err(failed)?.path();
            if path.extension().is_none_or(|extension| extension != EXTENSION) {
                continue;
            }
            match intact(&path) {
                Ok(header) => headers.push(header),
                Err(error) if files::is_damage(&error) => {
                    tell(Damaged {
                        key: key_of_file(&path),
                        kept: files::set_aside(&path)?,
                        reason: error.to_string(),
                    });
                }
                Err(error) => return Err(error.into()),
            }
        }
        headers.sort_by_key(|header| (header.device, header.model));
        Ok((store, headers))
    }

    /// The same folder for a reader beside the program that has opened it. Nothing is read, deleted or set aside.
    pub fn beside(folder: &Path) -> Self {
        Self { folder: folder.to_owned() }
    }

    /// Writes a model. The model survives a power cut once this function has returned.
    pub fn put(&self, header: &ModelHeader, body: &[u8]) -> Result<(), StoreError> {
        let head = head_of(header);
        atomic::write_sized(&self.path(header.into()), (head.len() + body.len()) as u64, |out| {
            out.write_all(&head)?;
            out.write_all(body)
        })?;
        Ok(())
    }

    /// Reads a model, and checks its hash and all its values.
    pub fn get(&self, key: ModelKey) -> Result<(ModelHeader, Vec<u8>), StoreError> {
        let path = self.path(key);
        let (mut file, header) = self.open_model(key)?;
        let mut body = vec![0; header.body_bytes as usize];
        file.read_exact(&mut body).map_err(|cause| SceneError::io(&path, cause))?;
        if body_hash(&body) != header.blake3 {
            return Err(malformed(&path, WRONG_HASH).into());
        }
        check_body(&header, &body).map_err(|fault| malformed(&path, &fault.to_string()))?;
        Ok((header, body))
    }

    /// Opens the file of a model behind its header. Fails if it holds another model.
    fn open_model(&self, key: ModelKey) -> Result<(File, ModelHeader), SceneError> {
        let path = self.path(key);
        let (file, header) = open_file(&path)?;
        if ModelKey::from(&header) != key {
            return Err(malformed(&path, WRONG_NAME));
        }
        Ok((file, header))
    }

    /// The header of a model, the frame of its splats, and its cameras, in the world. Reads only the beginning of the file;
    /// splats and hash are not checked. An error if the model has more cameras than fit into 2 MiB.
    pub fn cameras(&self, key: ModelKey) -> Result<(ModelHeader, LocalFrame, Vec<Camera>), StoreError> {
        let path = self.path(key);
        let (file, header) = self.open_model(key)?;
        let mut beginning = Vec::new();
        let read = file.take(CAMERAS_BYTES_MAX).read_to_end(&mut beginning);
        read.map_err(|cause| SceneError::io(&path, cause))?;
        match body_cameras(&beginning, header.body_bytes) {
            Ok(Some((frame, cameras))) => Ok((header, frame, cameras)),
            Ok(None) => Err(malformed(&path, "its cameras take more than 2 MiB").into()),
            Err(fault) => Err(malformed(&path, &fault.to_string()).into()),
        }
    }

    /// The keys of all models, by the names of their files. Files with other names are left out.
    pub fn keys(&self) -> Result<Vec<ModelKey>, StoreError> {
        let failed = |cause| SceneError::io(&self.folder, cause);
        let mut keys = Vec::new();
        for entry in fs::read_dir(&self.folder).map_err(failed)? {
            let name = entry.map_err(failed)?.file_name();
            keys.extend(name.to_str().and_then(|name| key_of(name, EXTENSION)));
        }
        Ok(keys)
    }

    /// The highest number of a model that was set aside, tiles not counted. It must not be used for another model.
    pub fn highest_set_aside(&self) -> Result<Option<ModelId>, StoreError> {
        let failed = |cause| SceneError::io(&self.folder, cause);
        let mut highest = None;
        for entry in fs::read_dir(&self.folder).map_err(failed)? {
            let name = entry.map_err(failed)?.file_name();
            let number = name.to_str().and_then(|name| name.split_once(".damaged")).and_then(|(name, _)| {
                let number: ModelId = name.split_once('.')?.1.parse().ok()?;
                Some(number).filter(|number| !number.is_tile())
            });
            highest = highest.max(number);
        }
        Ok(highest)
    }

    /// Reads the header of a model.
    pub fn header(&self, key: ModelKey) -> Result<ModelHeader, StoreError> {
        Ok(open_file(&self.path(key))?.1)
    }

    /// Whether the file of a model is there.
    pub fn has(&self, key: ModelKey) -> bool {
        self.path(key).is_file()
    }

    /// Renames the file of a damaged model, so that it no longer counts. Does nothing if it is missing.
    pub fn put_aside(&self, key: ModelKey) -> Result<(), StoreError> {
        let path = self.path(key);
        match files::set_aside(&path) {
            Err(SceneError::Io { cause, .. }) if cause.kind() == io::ErrorKind::NotFound => Ok(()),
            other => Ok(other.map(drop)?),
        }
    }

    /// Deletes a model. Does nothing if it is not stored.
    pub fn remove(&self, key: ModelKey) -> Result<(), StoreError> {
        let path = self.path(key);
        match fs::remove_file(&path) {
            Err(cause) if cause.kind() != io::ErrorKind::NotFound => Err(SceneError::io(&path, cause).into()),
            _ => Ok(()),
        }
    }

    /// The file of a model, whether it is there or not.
    pub fn path(&self, key: ModelKey) -> PathBuf {
        self.folder.join(format!("{}.{}.{EXTENSION}", key.device, key.model))
    }
}

/// The key of a model by the name of its file.
fn key_of_file(path: &Path) -> Option<ModelKey> {
    key_of(path.file_name()?.to_str()?, EXTENSION)
}

/// The key in the name of a file `{device}.{model}.{extension}`.
pub(crate) fn key_of(name: &str, extension: &str) -> Option<ModelKey> {
    let (device, number) = name.strip_suffix(extension)?.strip_suffix('.')?.split_once('.')?;
    Some(ModelKey { device: device.parse().ok()?, model: number.parse().ok()? })
}

/// Reads the header, and checks that the file has the size that follows from the header. Returns the file,
/// positioned at the start of the body.
fn open_file(path: &Path) -> Result<(fs::File, ModelHeader), SceneError> {
    let mut file = files::open(path)?;
    let (header, head_bytes) = read_head(path, &mut file)?;
    let size = file.metadata().map_err(|cause| SceneError::io(path, cause))?.len();
    if size != head_bytes + header.body_bytes {
        return Err(malformed(path, "its size does not match its header"));
    }
    Ok((file, header))
}

/// The beginning of a file of a model: the length of the header, and the header.
pub(crate) fn head_of(header: &ModelHeader) -> Vec<u8> {
    let mut buffer = [0; MAX_CONTROL_BYTES];
    // Cannot fail: a test of the wire crate checks the largest header.
    let head = Message::Header(*header).encode(&mut buffer).expect("a header fits MAX_CONTROL_BYTES");
    [&(head.len() as u16).to_le_bytes(), head].concat()
}

/// Reads what [`head_of`] makes. Returns the header and the number of bytes read.
pub(crate) fn read_head(path: &Path, file: &mut impl Read) -> Result<(ModelHeader, u64), SceneError> {
    let failed = |cause| SceneError::io(path, cause);
    let mut length = [0; 2];
    file.read_exact(&mut length).map_err(failed)?;
    let length = u16::from_le_bytes(length);
    let mut buffer = [0; MAX_CONTROL_BYTES];
    let head =
        buffer.get_mut(..usize::from(length)).ok_or_else(|| malformed(path, "its header is too long"))?;
    file.read_exact(head).map_err(failed)?;
    match Message::decode_stored(head) {
        Ok(Message::Header(header)) => Ok((header, 2 + u64::from(length))),
        Ok(_) => Err(malformed(path, "it does not begin with a header")),
        Err(error) => Err(malformed(path, &error.to_string())),
    }
}

/// Reads the header of a file whose body has the header's hash, and whose name is that of its model.
fn intact(path: &Path) -> Result<ModelHeader, SceneError> {
    let (file, header) = open_file(path)?;
    let mut hasher = blake3::Hasher::new();
    hasher.update_reader(file).map_err(|cause| SceneError::io(path, cause))?;
    if hasher.finalize().as_bytes() != &header.blake3.0 {
        return Err(malformed(path, WRONG_HASH));
    }
    if key_of_file(path) != Some(ModelKey::from(&header)) {
        return Err(malformed(path, WRONG_NAME));
    }
    Ok(header)
}

fn malformed(path: &Path, what: &str) -> SceneError {
    SceneError::malformed(path, what)
}
