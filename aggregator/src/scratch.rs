//! Temporary files for what a merge or a mesh does not keep in memory. They have no names, so nothing is left of them, however the program
//! ends.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::marker::PhantomData;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use bytemuck::Pod;
use cosurf_scene::files::{self, with_space};
use cosurf_scene::{SceneError, Splats};
use serde::Serialize;
use serde::de::DeserializeOwned;

/// The folder in which the files are made.
#[derive(Clone, Debug)]
pub(crate) struct Scratch(PathBuf);

/// A file of values of one type, all of the same size. Several threads may read it.
#[derive(Debug)]
pub(crate) struct Column<T> {
    file: Mutex<File>,
    folder: PathBuf,
    /// Number of values.
    len: u64,
    of: PhantomData<T>,
}

/// A file of numbers.
pub(crate) type Floats = Column<f32>;

/// A file of encoded values of any kind. Several threads may read it.
#[derive(Debug)]
pub(crate) struct Records {
    file: Mutex<File>,
    folder: PathBuf,
    bytes: u64,
}

/// Where a value lies in a file of [`Records`].
#[derive(Clone, Copy, Debug)]
pub(crate) struct Record {
    at: u64,
    bytes: usize,
}

impl Records {
    /// An empty file in `folder`, which is made if it is missing.
    pub(crate) fn new(folder: &Path) -> Result<Self, SceneError> {
        Scratch::new(folder)?.records()
    }

    /// Appends a value.
    pub(crate) fn put(&mut self, value: &impl Serialize) -> Result<Record, SceneError> {
        let encoded = postcard::to_stdvec(value).map_err(|error| self.failed(io::Error::other(error)))?;
        let record = Record { at: self.bytes, bytes: encoded.len() };
        let file = self.file.get_mut().unwrap_or_else(PoisonError::into_inner);
        let written = file.seek(SeekFrom::Start(record.at)).and_then(|_| file.write_all(&encoded));
        written.map_err(|cause| not_written(&self.folder, cause, self.bytes, encoded.len()))?;
        self.bytes += encoded.len() as u64;
        Ok(record)
    }

    /// Reads a value. It must have the type of the one that was appended.
    pub(crate) fn get<T: DeserializeOwned>(&self, record: Record) -> Result<T, SceneError> {
        let mut encoded = vec![0; record.bytes];
        let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        let read = file.seek(SeekFrom::Start(record.at)).and_then(|_| file.read_exact(&mut encoded));
        drop(file);
        read.map_err(|cause| self.failed(cause))?;
        postcard::from_bytes(&encoded).map_err(|error| self.failed(io::Error::other(error)))
    }

    fn failed(&self, cause: io::Error) -> SceneError {
        SceneError::io(&self.folder, cause)
    }
}

impl Scratch {
    /// Makes files in `folder`, which is made if it is missing.
    pub(crate) fn new(folder: &Path) -> Result<Self, SceneError> {
        files::create_folder(folder)?;
        Ok(Self(folder.to_owned()))
    }

    /// The folder.
    pub(crate) fn folder(&self) -> &Path {
        &self.0
    }

    /// An empty file of values.
    pub(crate) fn column<T: Pod>(&self) -> Result<Column<T>, SceneError> {
        Ok(Column { file: self.file()?, folder: self.0.clone(), len: 0, of: PhantomData })
    }

    /// An empty file of records.
    pub(crate) fn records(&self) -> Result<Records, SceneError> {
        Ok(Records { file: self.file()?, folder: self.0.clone(), bytes: 0 })
    }

    fn file(&self) -> Result<Mutex<File>, SceneError> {
        tempfile::tempfile_in(&self.0).map(Mutex::new).map_err(|cause| SceneError::io(&self.0, cause))
    }
}

impl<T: Pod> Column<T> {
    /// Number of values.
    pub(crate) fn len(&self) -> u64 {
        self.len
    }

    /// Bytes of the file.
    pub(crate) fn bytes(&self) -> u64 {
        self.len * size_of::<T>() as u64
    }

    /// Appends values. Returns the place of the first one.
    pub(crate) fn append(&mut self, values: &[T]) -> Result<u64, SceneError> {
        let held_bytes = self.bytes();
        let file = self.file.get_mut().unwrap_or_else(PoisonError::into_inner);
        let write = |mut file: &File| {
            file.seek(SeekFrom::Start(held_bytes))?;
            file.write_all(bytemuck::cast_slice(values))
        };
        let bytes = size_of_val(values);
        write(file).map_err(|cause| {
            let _ = file.set_len(held_bytes); // gives back what was written, so that it counts as free
            not_written(&self.folder, cause, held_bytes, bytes)
        })?;
        let at = self.len;
        self.len += values.len() as u64;
        Ok(at)
    }

    /// Fills `values` with those from the place `at` on.
    pub(crate) fn read(&self, at: u64, values: &mut [T]) -> Result<(), SceneError> {
        let mut read = || -> io::Result<()> {
            let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
            file.seek(SeekFrom::Start(at * size_of::<T>() as u64))?;
            file.read_exact(bytemuck::cast_slice_mut(values))
        };
        read().map_err(|cause| SceneError::io(&self.folder, cause))
    }

    /// Replaces the value at the place `at`.
    pub(crate) fn set(&mut self, at: u64, value: T) -> Result<(), SceneError> {
        let file = self.file.get_mut().unwrap_or_else(PoisonError::into_inner);
        let write = |file: &mut File| {
            file.seek(SeekFrom::Start(at * size_of::<T>() as u64))?;
            file.write_all(bytemuck::bytes_of(&value))
        };
        write(file).map_err(|cause| SceneError::io(&self.folder, cause))
    }
}

impl Floats {
    /// Appends splats. Returns their place.
    pub(crate) fn append_splats(&mut self, splats: &Splats) -> Result<u64, SceneError> {
        let at = self.len;
        numbers(splats).into_iter().try_for_each(|values| self.append(values).map(|_| ()))?;
        Ok(at)
    }

    /// Appends to `splats` those at the place `at`, of the same degree of spherical harmonics.
    pub(crate) fn read_splats(&self, at: u64, count: usize, splats: &mut Splats) -> Result<(), SceneError> {
        let (sh_stride, before) = (splats.sh_stride(), splats.len());
        let all = before + count;
        splats.means.resize(all, [0.0; 3]);
        splats.quats.resize(all, [0.0; 4]);
        splats.log_scales.resize(all, [0.0; 3]);
        splats.opacity_logits.resize(all, 0.0);
        splats.sh.resize(all * sh_stride, 0.0);
        let mut at = at;
        let mut fill = |values: &mut [f32]| {
            self.read(at, values)?;
            at += values.len() as u64;
            Ok(())
        };
        fill(splats.means[before..].as_flattened_mut())?;
        fill(splats.quats[before..].as_flattened_mut())?;
        fill(splats.log_scales[before..].as_flattened_mut())?;
        fill(&mut splats.opacity_logits[before..])?;
        fill(&mut splats.sh[before * sh_stride..])
    }
}

/// The error of a write of so many bytes to a file that has `held_bytes`. Those count as free and as needed: once the work has
/// failed they are free, and the next attempt needs them again.
fn not_written(folder: &Path, cause: io::Error, held_bytes: u64, bytes: usize) -> SceneError {
    beside(with_space(SceneError::io(folder, cause), folder, bytes as u64), held_bytes)
}

/// That of a full disk with more bytes free and needed: those of files that the failed work had, see [`not_written`].
pub(crate) fn beside(error: SceneError, held_bytes: u64) -> SceneError {
    match error {
        SceneError::DiskFull { folder, free_bytes, needed_bytes } => SceneError::DiskFull {
            folder,
            free_bytes: free_bytes.saturating_add(held_bytes),
            needed_bytes: needed_bytes.saturating_add(held_bytes),
        },
        error => error,
    }
}

/// All numbers of splats.
pub(crate) fn numbers(splats: &Splats) -> [&[f32]; 5] {
    let Splats { means, quats, log_scales, opacity_logits, sh, .. } = splats;
    [means.as_flattened(), quats.as_flattened(), log_scales.as_flattened(), opacity_logits, sh]
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::testing::ground;

    #[test]
    fn splats_come_back() {
        let folder = tempfile::tempdir().unwrap();
        let mut floats: Floats = Scratch::new(folder.path()).unwrap().column().unwrap();
        let [one, two] = [ground(0.0, 2.0), ground(5.0, 6.0)];
        let places = [&one, &two].map(|splats| floats.append_splats(splats).unwrap());
        let mut read = Splats::with_capacity(0, 0);
        floats.read_splats(places[1], two.len(), &mut read).unwrap();
        assert_eq!(read, two);
        floats.read_splats(places[0], one.len(), &mut read).unwrap();
        let mut both = two;
        both.extend(&one);
        assert_eq!(read, both);
    }

    #[test]
    fn records_come_back() {
        let folder = tempfile::tempdir().unwrap();
        let mut records = Records::new(folder.path()).unwrap();
        let one = records.put(&("one".to_owned(), vec![1.5f64, -2.0])).unwrap();
        let two = records.put(&[7u32; 3]).unwrap();
        assert_eq!(records.get::<[u32; 3]>(two).unwrap(), [7; 3]);
        assert_eq!(records.get::<(String, Vec<f64>)>(one).unwrap(), ("one".to_owned(), vec![1.5, -2.0]));
        let error = records.get::<String>(Record { at: 1000, bytes: 3 }).unwrap_err().to_string();
        assert!(error.contains(folder.path().to_str().unwrap()), "{error}");
    }

    #[test]
    #[cfg(unix)]
    fn a_full_disk_is_told_with_what_the_file_has_and_needs() {
        let folder = tempfile::tempdir().unwrap();
        let told = |cause: io::ErrorKind, bytes| {
            not_written(folder.path(), cause.into(), 5000 << 40, bytes).to_string()
        };
        let text = told(io::ErrorKind::StorageFull, 1 << 60);
        assert!(text.contains("TiB free, at least ") && text.contains("TiB are needed"), "{text}");
        let text = told(io::ErrorKind::StorageFull, 0);
        assert!(text.contains("the disk is full"), "the space was freed since: {text}");
        assert!(told(io::ErrorKind::PermissionDenied, 1 << 60).contains("permission denied"));
    }

    #[test]
    fn numbers_come_back_and_no_file_is_left() {
        let folder = tempfile::tempdir().unwrap();
        let scratch = Scratch::new(&folder.path().join("made")).unwrap();
        let mut floats: Floats = scratch.column().unwrap();
        assert_eq!([floats.append(&[1.0, 2.0]).unwrap(), floats.append(&[3.0]).unwrap()], [0, 2]);
        let mut values = [0.0; 2];
        floats.read(1, &mut values).unwrap();
        assert_eq!(values, [2.0, 3.0]);
        floats.set(1, 5.0).unwrap();
        floats.read(1, &mut values).unwrap();
        assert_eq!(values, [5.0, 3.0]);
        let error = floats.read(2, &mut values).unwrap_err().to_string();
        assert!(error.contains("made"), "{error}");
        assert_eq!(std::fs::read_dir(folder.path().join("made")).unwrap().count(), 0);
    }
}
