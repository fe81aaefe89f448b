//! Objects under names: bytes that are written once and read as a whole, in a folder or in a bucket.
//!
//! An object is either there completely or not at all, however the program ends.
//!
//! What it knows nothing about: what the bytes mean, and whether they are still what was written. Its users check that.

use std::fmt::Display;
use std::fs;
use std::ops::Range;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use object_store::aws::{AmazonS3, AmazonS3Builder, AmazonS3ConfigKey};
use object_store::local::LocalFileSystem;
use object_store::path::Path as Name;
use object_store::prefix::PrefixStore;
use object_store::{Error, ObjectStore, ObjectStoreExt, RetryConfig};
use tokio::runtime::{Builder, Runtime};

/// A file of an unfinished object is removed once nothing was written to it for so long: until then, another program
/// may be writing it.
const UNFINISHED_MAX: Duration = Duration::from_secs(900);
/// A bucket that fails for so long is taken for away.
const BUCKET_PATIENCE: Duration = Duration::from_secs(20);
/// What the address of a bucket begins with.
const BUCKET_SCHEME: &str = "s3://";

/// Objects under names. Several threads may use it.
#[derive(Clone, Debug)]
pub struct Store {
    objects: Arc<dyn ObjectStore>,
    runtime: Arc<Runtime>,
    /// Where the objects are, for errors.
    place: String,
    kind: Kind,
    /// The folder of the objects, inside that place; empty for the place itself.
    folder: String,
}

/// Where objects are.
#[derive(Clone, Copy, Debug)]
enum Kind {
    Folder,
    Bucket,
}

/// Why an object was not read, written or removed.
#[derive(Debug, thiserror::Error)]
#[error("{place}: {cause}; check that {}", kind.remedy())]
pub struct ObjectError {
    place: String,
    kind: Kind,
    /// One line, even if a server has answered with more.
    cause: String,
}

impl ObjectError {
    fn new(place: String, kind: Kind, cause: impl Display) -> Self {
        let cause = cause.to_string();
        let words: Vec<&str> = cause.split_whitespace().collect();
        Self { place, kind, cause: words.join(" ") }
    }
}

impl Kind {
    fn remedy(self) -> &'static str {
        match self {
            Self::Folder => "it exists, that it can be written to, and that there is free space",
            Self::Bucket => {
                "the bucket exists, and that AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_REGION and \
                 (outside of Amazon) AWS_ENDPOINT_URL are right"
            }
        }
    }
}

impl Store {
    /// Objects in a folder, which is made if it is missing, or in an S3 bucket, for example `s3://bucket/prefix`. Keys,
    /// region and endpoint of a bucket come from the environment variables that Amazon's tools use. Fails if the bucket
    /// does not answer, or refuses the keys.
    pub fn open(place: &str) -> Result<Self, ObjectError> {
        match place.split_once("://") {
            Some(("s3", bucket)) => Self::in_bucket(bucket),
            Some(_) => {
                let cause = "not a folder, and not an address like s3://bucket/prefix";
                Err(ObjectError::new(place.to_owned(), Kind::Folder, cause))
            }
            None => Self::in_folder(Path::new(place)),
        }
    }

    /// Objects in the files of a folder, which is made if it is missing.
    pub fn in_folder(folder: &Path) -> Result<Self, ObjectError> {
        let place = folder.display().to_string();
        let open = || {
            fs::create_dir_all(folder)?;
            remove_unfinished(folder)?;
            let objects: Arc<dyn ObjectStore> = Arc::new(LocalFileSystem::new_with_prefix(folder)?);
            Ok((objects, Builder::new_current_thread().build()?))
        };
        Self::new(place, Kind::Folder, open())
    }

    /// Objects whose names begin with a prefix, in an S3 bucket: `bucket/prefix`, or `bucket` for no prefix.
    fn in_bucket(place: &str) -> Result<Self, ObjectError> {
        let (bucket, prefix) = place.split_once('/').unwrap_or((place, ""));
        let open = || {
            let objects: Arc<dyn ObjectStore> = Arc::new(PrefixStore::new(bucket_of(bucket)?, prefix));
            // A thread of its own keeps connections alive while the program computes.
            Ok((objects, Builder::new_multi_thread().worker_threads(1).enable_all().build()?))
        };
        let store = Self::new(format!("{BUCKET_SCHEME}{place}"), Kind::Bucket, open())?;
        store.names()?; // wrong keys and a wrong endpoint are told at once
        Ok(store)
    }

    fn new(
        place: String,
        kind: Kind,
        opened: Result<(Arc<dyn ObjectStore>, Runtime), Box<dyn std::error::Error + Send + Sync>>,
    ) -> Result<Self, ObjectError> {
        match opened {
            Ok((objects, runtime)) => {
                Ok(Self { objects, runtime: Arc::new(runtime), place, kind, folder: String::new() })
            }
            Err(cause) => Err(ObjectError::new(place, kind, cause)),
        }
    }

    /// The objects in a folder of this store.
    pub fn folder(&self, name: &str) -> Self {
        Self { folder: name.to_owned(), ..self.clone() }
    }

    /// The name of the folder that [`Self::folder`] was given, else empty.
    pub fn folder_name(&self) -> &str {
        &self.folder
    }

    fn path(&self, name: &str) -> Name {
        Name::from_iter([self.folder.as_str(), name].into_iter().filter(|part| !part.is_empty()))
    }

    /// The object of this name; `None` if there is none.
    pub fn get(&self, name: &str) -> Result<Option<Bytes>, ObjectError> {
        let path = self.path(name);
        let read = async { self.objects.get(&path).await?.bytes().await };
        found(self.runtime.block_on(read)).map_err(|cause| self.error(name, cause))
    }

    /// Some of the bytes of an object; `None` if there is no such object.
    pub fn get_range(&self, name: &str, range: Range<u64>) -> Result<Option<Bytes>, ObjectError> {
        let read = self.runtime.block_on(self.objects.get_range(&self.path(name), range));
        found(read).map_err(|cause| self.error(name, cause))
    }

    /// Number of bytes of an object; `None` if there is no such object.
    pub fn size(&self, name: &str) -> Result<Option<u64>, ObjectError> {
        let head = self.runtime.block_on(self.objects.head(&self.path(name)));
        found(head.map(|head| head.size)).map_err(|cause| self.error(name, cause))
    }

    /// Writes an object. One of the same name is replaced.
    pub fn put(&self, name: &str, bytes: Bytes) -> Result<(), ObjectError> {
        let written = self.runtime.block_on(self.objects.put(&self.path(name), bytes.into()));
        written.map(|_| ()).map_err(|cause| self.error(name, cause))
    }

    /// Writes an object that is too large for the memory. `next` returns one part after the other, and `None` after the
    /// last. All parts but the last must have the same size, at least 5 MiB.
    pub fn put_parts<E: From<ObjectError>>(
        &self,
        name: &str,
        mut next: impl FnMut() -> Result<Option<Bytes>, E>,
    ) -> Result<(), E> {
        let error = |cause| E::from(self.error(name, cause));
        let begun = self.runtime.block_on(self.objects.put_multipart(&self.path(name)));
        let mut upload = begun.map_err(error)?;
        let mut write_all = || {
            while let Some(part) = next()? {
                self.runtime.block_on(upload.put_part(part.into())).map_err(error)?;
            }
            self.runtime.block_on(upload.complete()).map(|_| ()).map_err(error)
        };
        let written = write_all();
        if written.is_err() {
            let _ = self.runtime.block_on(upload.abort()); // the first error tells more
        }
        written
    }

    /// Removes an object, if it is there.
    pub fn remove(&self, name: &str) -> Result<(), ObjectError> {
        let removed = self.runtime.block_on(self.objects.delete(&self.path(name)));
        found(removed).map(|_| ()).map_err(|cause| self.error(name, cause))
    }

    /// The names of all objects.
    pub fn names(&self) -> Result<Vec<String>, ObjectError> {
        let prefix = (!self.folder.is_empty()).then(|| Name::from(self.folder.as_str()));
        let listed = self.runtime.block_on(self.objects.list_with_delimiter(prefix.as_ref()));
        let listed = listed.map_err(|cause| self.error("", cause))?;
        Ok(listed.objects.iter().filter_map(|object| object.location.filename()).map(str::to_owned).collect())
    }

    /// Removes all objects whose names do not satisfy `wanted`.
    pub fn keep_only(&self, wanted: impl Fn(&str) -> bool) -> Result<(), ObjectError> {
        self.names()?.iter().filter(|name| !wanted(name)).try_for_each(|name| self.remove(name))
    }

    fn error(&self, name: &str, cause: Error) -> ObjectError {
        ObjectError::new(format!("{}/{}", self.place, self.path(name)), self.kind, cause)
    }
}

/// A bucket of S3, or of a server that speaks its language.
fn bucket_of(name: &str) -> Result<AmazonS3, Error> {
    let _ = rustls::crypto::ring::default_provider().install_default(); // fails if it is installed already
    let retry = RetryConfig { retry_timeout: BUCKET_PATIENCE, ..RetryConfig::default() };
    let mut builder = AmazonS3Builder::from_env().with_bucket_name(name).with_retry(retry);
    let endpoint = builder.get_config_value(&AmazonS3ConfigKey::Endpoint);
    if endpoint.is_some_and(|url| url.starts_with("http://")) {
        builder = builder.with_allow_http(true); // whoever writes http means it
    }
    builder.build()
}

/// `None` if an object does not exist.
fn found<T>(outcome: Result<T, Error>) -> Result<Option<T>, Error> {
    match outcome {
        Err(Error::NotFound { .. }) => Ok(None),
        outcome => outcome.map(Some),
    }
}

/// Removes the files of objects whose writing was interrupted. [`LocalFileSystem`] writes an object to a file with this
/// sign and a number behind its name, and then renames it.
fn remove_unfinished(folder: &Path) -> std::io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let age = entry.metadata()?.modified()?.elapsed().unwrap_or_default();
        if entry.file_name().to_string_lossy().contains('#') && age > UNFINISHED_MAX {
            fs::remove_file(entry.path())?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::io::Write;
    use std::time::SystemTime;

    use super::*;

    #[test]
    fn large_objects_are_written_and_read_in_parts() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::in_folder(folder.path()).unwrap().folder("site");
        let mut parts = ["three ", "parts ", "here"].into_iter();
        store.put_parts("a", || Ok::<_, ObjectError>(parts.next().map(Bytes::from))).unwrap();
        assert_eq!(store.get("a").unwrap().unwrap(), "three parts here");
        assert_eq!(store.size("a").unwrap(), Some(16));
        assert_eq!(store.get_range("a", 6..11).unwrap().unwrap(), "parts");
        assert_eq!(store.names().unwrap(), ["a"]);
        assert!(folder.path().join("site/a").is_file());
        let mut parts = 0;
        let failed = store.put_parts("b", || {
            parts += 1;
            if parts == 2 {
                Err(store.error(
                    "b",
                    Error::NotImplemented { operation: String::new(), implementer: String::new() },
                ))
            } else {
                Ok(Some(Bytes::from("half")))
            }
        });
        assert!(failed.is_err());
        assert_eq!((store.get("b").unwrap(), store.size("b").unwrap()), (None, None), "no half object");
        assert_eq!(store.names().unwrap(), ["a"]);
    }

    #[test]
    fn objects_come_back_and_unwanted_ones_go() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("made");
        let store = Store::in_folder(&path).unwrap();
        assert_eq!(store.get("a").unwrap(), None);
        for (name, bytes) in [("a", "one"), ("b", "two"), ("a", "three")] {
            store.put(name, Bytes::from(bytes)).unwrap();
        }
        for (name, age) in [("c#1", 2 * UNFINISHED_MAX), ("d#1", Duration::ZERO)] {
            let mut half = fs::File::create(path.join(name)).unwrap();
            half.write_all(b"half of").unwrap();
            half.set_modified(SystemTime::now() - age).unwrap();
        }
        let store = Store::in_folder(&path).unwrap();
        assert_eq!(store.get("a").unwrap().unwrap(), "three");
        assert_eq!(fs::read_dir(&path).unwrap().count(), 3, "only the old unfinished object is removed");
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
