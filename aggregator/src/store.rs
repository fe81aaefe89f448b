//! Objects under names: bytes that are written once and read as a whole, in a folder or in a bucket.
//!
//! An object is either there completely or not at all, however the program ends.
//!
//! What it knows nothing about: what the bytes mean, and whether they are still what was written. Its users check that.

use std::fs;
use std::path::Path;
use std::sync::Arc;

use bytes::Bytes;
use object_store::local::LocalFileSystem;
use object_store::path::Path as Name;
use object_store::{Error, ObjectStore, ObjectStoreExt};
use tokio::runtime::{Builder, Runtime};

/// Objects under names. Several threads may use it.
#[derive(Clone, Debug)]
pub struct Store {
    objects: Arc<dyn ObjectStore>,
    runtime: Arc<Runtime>,
    /// Where the objects are, for errors.
    place: String,
}

/// Why an object was not read, written or removed.
#[derive(Debug, thiserror::Error)]
#[error("{place}: {cause}; check that it exists, that it can be written to, and that there is free space")]
pub struct ObjectError {
    place: String,
    cause: Box<dyn std::error::Error + Send + Sync>,
}

impl Store {
    /// Objects in the files of a folder, which is made if it is missing.
    pub fn in_folder(folder: &Path) -> Result<Self, ObjectError> {
        let place = folder.display().to_string();
        let objects = fs::create_dir_all(folder)
            .and_then(|()| remove_unfinished(folder))
            .map_err(|cause| ObjectError { place: place.clone(), cause: cause.into() })
            .and_then(|()| {
                LocalFileSystem::new_with_prefix(folder)
                    .map_err(|cause| ObjectError { place: place.clone(), cause: cause.into() })
            })?;
        let runtime = Builder::new_current_thread().build();
        let runtime = runtime.map_err(|cause| ObjectError { place: place.clone(), cause: cause.into() })?;
        Ok(Self { objects: Arc::new(objects), runtime: Arc::new(runtime), place })
    }

    /// The object of this name; `None` if there is none.
    pub fn get(&self, name: &str) -> Result<Option<Bytes>, ObjectError> {
        let read = async { self.objects.get(&Name::from(name)).await?.bytes().await };
        match self.runtime.block_on(read) {
            Ok(bytes) => Ok(Some(bytes)),
            Err(Error::NotFound { .. }) => Ok(None),
            Err(cause) => Err(self.error(name, cause)),
        }
    }

    /// Writes an object. One of the same name is replaced.
    pub fn put(&self, name: &str, bytes: Bytes) -> Result<(), ObjectError> {
        let written = self.runtime.block_on(self.objects.put(&Name::from(name), bytes.into()));
        written.map(|_| ()).map_err(|cause| self.error(name, cause))
    }

    /// Removes all objects whose names do not satisfy `wanted`.
    pub fn keep_only(&self, wanted: impl Fn(&str) -> bool) -> Result<(), ObjectError> {
        let listed = self.runtime.block_on(self.objects.list_with_delimiter(None));
        let listed = listed.map_err(|cause| self.error("", cause))?;
        let unwanted = listed.objects.iter().filter(|object| !wanted(object.location.as_ref()));
        for object in unwanted {
            match self.runtime.block_on(self.objects.delete(&object.location)) {
                Ok(()) | Err(Error::NotFound { .. }) => {}
                Err(cause) => return Err(self.error(object.location.as_ref(), cause)),
            }
        }
        Ok(())
    }

    fn error(&self, name: &str, cause: Error) -> ObjectError {
        ObjectError { place: format!("{}/{name}", self.place), cause: cause.into() }
    }
}

/// Removes the files of objects whose writing was interrupted. [`LocalFileSystem`] writes an object to a file with this
/// sign and a number behind its name, and then renames it.
fn remove_unfinished(folder: &Path) -> std::io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        if entry.file_name().to_string_lossy().contains('#') {
            fs::remove_file(entry.path())?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn objects_come_back_and_unwanted_ones_go() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("made");
        let store = Store::in_folder(&path).unwrap();
        assert_eq!(store.get("a").unwrap(), None);
        for (name, bytes) in [("a", "one"), ("b", "two"), ("a", "three")] {
            store.put(name, Bytes::from(bytes)).unwrap();
        }
        fs::write(path.join("c#1"), "half of").unwrap();
        let store = Store::in_folder(&path).unwrap();
        assert_eq!(store.get("a").unwrap().unwrap(), "three");
        assert_eq!(fs::read_dir(&path).unwrap().count(), 2, "an unfinished object is removed");
        store.keep_only(|name| name == "b").unwrap();
        assert_eq!([store.get("a").unwrap(), store.get("b").unwrap()], [None, Some(Bytes::from("two"))]);
    }

    #[test]
    fn an_object_that_cannot_be_written_is_told_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::in_folder(folder.path()).unwrap();
        fs::create_dir(folder.path().join("a")).unwrap();
        fs::write(folder.path().join("a/b"), "").unwrap();
        let error = store.put("a", Bytes::from("one")).unwrap_err().to_string();
        assert!(error.contains("/a: ") && error.contains("free space"), "{error}");
        assert!(Store::in_folder(&folder.path().join("a/b")).is_err(), "a file instead of a folder");
    }
}
