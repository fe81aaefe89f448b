//! What has arrived of unfinished models, on disk: a program that is killed in the middle of a transfer goes on with it.
//!
//! A file `{device}.{model}.arrived` holds the model's header, as a file of [`crate::ModelStore`] does, and then a record
//! for each chunk, in order of arrival:
//!
//! | bytes | |
//! |---|---|
//! | 8 | the first byte of the chunk in the body, `u64`, little-endian |
//! | 4 | number of bytes of the chunk, `u32`, little-endian |
//! | 8 | the first bytes of the BLAKE3 hash of the two numbers and the chunk |
//! | | the chunk |
//!
//! Nothing is synced: a kill loses nothing, and what a power cut loses is sent again. From the first damaged record on, a
//! file counts as not written. A folder that cannot be written only loses this; the log tells it once.

use std::fs::{self, File, OpenOptions};
use std::io::{self, BufReader, Read, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};

use cosurf_scene::{SceneError, files};
use cosurf_wire::{MAX_CHUNK_BYTES, ModelHeader};

use crate::key::ModelKey;
use crate::store::{StoreError, head_of, key_of, read_head};

const EXTENSION: &str = "arrived";
/// Size of the numbers and the hash before each chunk.
const RECORD_BYTES: usize = 20;
/// Size of the numbers alone.
const NUMBERS_BYTES: usize = 12;

/// A folder with what has arrived of unfinished models. It may be that of a [`crate::ModelStore`].
#[derive(Debug)]
pub(crate) struct ArrivedStore {
    folder: PathBuf,
    /// Limit on the size of all files together.
    bytes_max: u64,
    /// The files, those first that were not written for longest.
    files: Vec<Kept>,
    is_fault_told: bool,
}

#[derive(Debug)]
struct Kept {
    header: ModelHeader,
    /// Size of the file.
    bytes: u64,
    /// Whether its splats were asked for since it was written last.
    is_used: bool,
}

impl Kept {
    fn key(&self) -> ModelKey {
        ModelKey::from(&self.header)
    }

    /// Whether the file is of this model. Its chunks may have another size.
    fn is_of(&self, header: &ModelHeader) -> bool {
        ModelHeader { chunk_bytes: header.chunk_bytes, ..self.header } == *header
    }
}

impl ArrivedStore {
    /// Opens or creates the folder. If its files take more than `bytes_max`, those are removed that were not written for
    /// longest.
    pub(crate) fn open(folder: &Path, bytes_max: u64) -> Result<Self, StoreError> {
        let failed = |cause| SceneError::io(folder, cause);
        files::create_folder(folder)?;
        let mut found = Vec::new();
        for entry in fs::read_dir(folder).map_err(failed)? {
            let entry = entry.map_err(failed)?;
            let Some(key) = entry.file_name().to_str().and_then(|name| key_of(name, EXTENSION)) else {
                continue;
            };
            match header_in(&entry.path()).filter(|(header, _)| ModelKey::from(header) == key) {
                Some((header, about)) => {
                    found.push((about.modified().ok(), Kept { header, bytes: about.len(), is_used: false }));
                }
                // What is in the way of a new file of this name, and of no use.
                None => files::set_aside(&entry.path()).map(drop)?,
            }
        }
        found.sort_by_key(|(modified, _)| *modified);
        let files = found.into_iter().map(|(_, kept)| kept).collect();
        let mut store = Self { folder: folder.to_owned(), bytes_max, files, is_fault_told: false };
        store.make_room(0, None);
        Ok(store)
    }

    /// Adds a chunk that begins at byte `first` of the body of a model.
    pub(crate) fn add(&mut self, header: &ModelHeader, first: u64, chunk: &[u8]) {
        let key = ModelKey::from(header);
        let mut record = Vec::with_capacity(RECORD_BYTES + chunk.len());
        record.extend_from_slice(&first.to_le_bytes());
        record.extend_from_slice(&(chunk.len() as u32).to_le_bytes());
        record.extend_from_slice(&check_of(&record, chunk));
        record.extend_from_slice(chunk);
        if !self.make_room(record.len() as u64, Some(key)) {
            return;
        }
        match self.append(header, &record) {
            Ok(()) => self.note(header, record.len() as u64),
            Err(cause) => {
                self.remove(key);
                if !std::mem::replace(&mut self.is_fault_told, true) {
                    let folder = self.folder.display();
                    tracing::warn!(
                        "{folder}: what arrives of unfinished models does not outlast a restart: {cause}"
                    );
                }
            }
        }
    }

    fn append(&self, header: &ModelHeader, record: &[u8]) -> io::Result<()> {
        let path = self.path(header.into());
        let is_new = !self.files.iter().any(|kept| kept.is_of(header));
        let mut file = match is_new {
            true => File::create(&path)?,
            false => OpenOptions::new().append(true).open(&path)?,
        };
        if is_new {
            file.write_all(&head_of(header))?;
        }
        file.write_all(record)
    }

    /// Notes that the file of a model has grown and is the one that was written last.
    fn note(&mut self, header: &ModelHeader, more: u64) {
        let before = self.files.iter().find(|kept| kept.is_of(header)).map_or(0, |kept| kept.bytes);
        self.files.retain(|kept| kept.key() != ModelKey::from(header));
        self.files.push(Kept { header: *header, bytes: before + more, is_used: false });
    }

    /// Gives each chunk to `take` that has arrived of a model, with the place of its first byte in the body. Returns where
    /// chunks lie, sorted and joined where they touch.
    pub(crate) fn read(&mut self, header: &ModelHeader, mut take: impl FnMut(u64, &[u8])) -> Vec<Range<u64>> {
        if !self.files.iter().any(|kept| kept.is_of(header)) {
            return Vec::new();
        }
        let ranges = self.read_records(header, &mut take);
        if ranges.is_err() {
            self.remove(header.into());
        }
        joined(ranges.unwrap_or_default())
    }

    fn read_records(
        &self,
        header: &ModelHeader,
        take: &mut impl FnMut(u64, &[u8]),
    ) -> Result<Vec<Range<u64>>, SceneError> {
        let path = self.path(header.into());
        let failed = |cause| SceneError::io(&path, cause);
        let mut file = BufReader::new(files::open(&path)?);
        let (_, mut intact) = read_head(&path, &mut file)?;
        let mut ranges = Vec::new();
        let mut chunk = Vec::new();
        while let Some(first) = next_record(&mut file, header.body_bytes, &mut chunk) {
            intact += (RECORD_BYTES + chunk.len()) as u64;
            take(first, &chunk);
            ranges.push(first..first + chunk.len() as u64);
        }
        // Records that follow must not be written behind a damaged one.
        let size = file.into_inner().metadata().map_err(failed)?.len();
        if size > intact {
            OpenOptions::new()
                .write(true)
                .open(&path)
                .and_then(|file| file.set_len(intact))
                .map_err(failed)?;
        }
        Ok(ranges)
    }

    /// The headers of the models of which more may have arrived since they were used.
    pub(crate) fn unused(&self) -> impl Iterator<Item = &ModelHeader> {
        self.files.iter().filter(|kept| !kept.is_used).map(|kept| &kept.header)
    }

    /// The header of a model in the folder, if more of it may have arrived since it was used. It counts as used from now on.
    pub(crate) fn begin_to_use(&mut self, key: ModelKey) -> Option<ModelHeader> {
        let kept = self.files.iter_mut().find(|kept| kept.key() == key && !kept.is_used)?;
        kept.is_used = true;
        Some(kept.header)
    }

    /// Bytes of a model that have arrived, at most.
    pub(crate) fn bytes_of(&self, header: &ModelHeader) -> u64 {
        self.files.iter().find(|kept| kept.is_of(header)).map_or(0, |kept| kept.bytes)
    }

    /// Removes what has arrived of a model.
    pub(crate) fn remove(&mut self, key: ModelKey) {
        self.remove_all(|other| *other == key);
    }

    /// Removes what has arrived of the models that `is_it` names.
    pub(crate) fn remove_all(&mut self, is_it: impl Fn(&ModelKey) -> bool) {
        let keys: Vec<ModelKey> = self.files.iter().map(Kept::key).filter(|key| is_it(key)).collect();
        self.files.retain(|kept| !keys.contains(&kept.key()));
        for key in keys {
            // If it cannot be removed, the next record begins a new file in its place.
            let _ = fs::remove_file(self.path(key));
        }
    }

    /// Removes files until `bytes` more fit, except that of `key`. Returns whether they fit.
    fn make_room(&mut self, bytes: u64, key: Option<ModelKey>) -> bool {
        loop {
            let total: u64 = self.files.iter().map(|kept| kept.bytes).sum();
            if total + bytes <= self.bytes_max {
                return true;
            }
            let Some(oldest) = self.files.iter().map(Kept::key).find(|other| Some(*other) != key) else {
                return false;
            };
            self.remove(oldest);
        }
    }

    fn path(&self, key: ModelKey) -> PathBuf {
        self.folder.join(format!("{}.{}.{EXTENSION}", key.device, key.model))
    }
}

/// The header of the model in a file, and what the disk knows about the file; `None` if it is damaged.
fn header_in(path: &Path) -> Option<(ModelHeader, fs::Metadata)> {
    let mut file = files::open(path).ok()?;
    let (header, _) = read_head(path, &mut file).ok()?;
    Some((header, file.metadata().ok()?))
}

/// The hash in a record with these numbers.
fn check_of(numbers: &[u8], chunk: &[u8]) -> [u8; 8] {
    let mut hasher = blake3::Hasher::new();
    hasher.update(numbers).update(chunk);
    let mut check = [0; 8];
    hasher.finalize_xof().fill(&mut check);
    check
}

/// Reads the next record, and returns the place of its chunk's first byte; `None` at the end, and if the record is damaged
/// or lies outside a body of `body_bytes`.
fn next_record(file: &mut impl Read, body_bytes: u64, chunk: &mut Vec<u8>) -> Option<u64> {
    let mut record = [0; RECORD_BYTES];
    file.read_exact(&mut record).ok()?;
    let (numbers, check) = record.split_at(NUMBERS_BYTES);
    let (first, length) = numbers.split_at(8);
    let first = u64::from_le_bytes(first.try_into().ok()?);
    let length = u32::from_le_bytes(length.try_into().ok()?) as usize;
    if length > MAX_CHUNK_BYTES || first.checked_add(length as u64)? > body_bytes {
        return None;
    }
    chunk.resize(length, 0);
    file.read_exact(chunk).ok()?;
    (check_of(numbers, chunk) == check).then_some(first)
}

/// The ranges sorted, and those joined that overlap or touch.
fn joined(mut ranges: Vec<Range<u64>>) -> Vec<Range<u64>> {
    ranges.sort_by_key(|range| range.start);
    let mut joined: Vec<Range<u64>> = Vec::new();
    for range in ranges {
        match joined.last_mut() {
            Some(last) if range.start <= last.end => last.end = last.end.max(range.end),
            _ => joined.push(range),
        }
    }
    joined
}
