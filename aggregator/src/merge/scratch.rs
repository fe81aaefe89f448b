//! Files for what a merge does not keep in memory. They have no names, so nothing is left of them, however the program
//! ends.

use std::fs::{self, File};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use cosurf_scene::SceneError;

/// The folder in which a merge makes its files.
#[derive(Clone, Debug)]
pub(super) struct Scratch(PathBuf);

/// A file of `f32` numbers. Several threads may read it.
#[derive(Debug)]
pub(super) struct Floats {
    file: Mutex<File>,
    folder: PathBuf,
    /// Number of numbers.
    len: u64,
}

impl Scratch {
    /// Makes files in `folder`, which is made if it is missing.
    pub(super) fn new(folder: &Path) -> Result<Self, SceneError> {
        fs::create_dir_all(folder).map_err(|cause| SceneError::io(folder, cause))?;
        Ok(Self(folder.to_owned()))
    }

    /// An empty file.
    pub(super) fn floats(&self) -> Result<Floats, SceneError> {
        let file = tempfile::tempfile_in(&self.0).map_err(|cause| SceneError::io(&self.0, cause))?;
        Ok(Floats { file: Mutex::new(file), folder: self.0.clone(), len: 0 })
    }
}

impl Floats {
    /// Appends numbers. Returns the place of the first one.
    pub(super) fn append(&mut self, values: &[f32]) -> Result<u64, SceneError> {
        let file = self.file.get_mut().unwrap_or_else(PoisonError::into_inner);
        let write = |file: &mut File| {
            file.seek(SeekFrom::Start(4 * self.len))?;
            file.write_all(bytemuck::cast_slice(values))
        };
        write(file).map_err(|cause| SceneError::io(&self.folder, cause))?;
        let at = self.len;
        self.len += values.len() as u64;
        Ok(at)
    }

    /// Fills `values` with the numbers from the place `at` on.
    pub(super) fn read(&self, at: u64, values: &mut [f32]) -> Result<(), SceneError> {
        let mut read = || -> io::Result<()> {
            let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
            file.seek(SeekFrom::Start(4 * at))?;
            file.read_exact(bytemuck::cast_slice_mut(values))
        };
        read().map_err(|cause| SceneError::io(&self.folder, cause))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn numbers_come_back_and_no_file_is_left() {
        let folder = tempfile::tempdir().unwrap();
        let scratch = Scratch::new(&folder.path().join("made")).unwrap();
        let mut floats = scratch.floats().unwrap();
        assert_eq!([floats.append(&[1.0, 2.0]).unwrap(), floats.append(&[3.0]).unwrap()], [0, 2]);
        let mut values = [0.0; 2];
        floats.read(1, &mut values).unwrap();
        assert_eq!(values, [2.0, 3.0]);
        let error = floats.read(2, &mut values).unwrap_err().to_string();
        assert!(error.contains("made"), "{error}");
        assert_eq!(fs::read_dir(folder.path().join("made")).unwrap().count(), 0);
    }
}
