//! Files that are whole or absent: written beside their place, synced, then renamed into it. Every
//! file that cosurf leaves behind goes through here, so a full disk, a kill or a power cut leaves
//! the file's last good version (or none), never half of a new one.

use std::ffi::OsString;
use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use crate::SceneError;

/// Bytes gathered before the operating system is asked to write; larger gains nothing measurable.
const BUFFER_BYTES: usize = 256 * 1024;

/// Ends the names of files that are not whole yet.
const SUFFIX: &str = ".partial";

/// Writes `path` through `fill`, atomically and durably: when it returns `Ok`, the content is on
/// the disk; when it returns an error, `path` is as it was and nothing is left beside it. The
/// folder must exist. Of several writers of one path, the last to end wins.
pub fn write(
    path: &Path,
    fill: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>,
) -> Result<(), SceneError> {
    let partial = Partial(partial_path(path));
    write_and_rename(&RealDisk, &partial.0, path, fill).map_err(|cause| SceneError::io(path, cause))
}

/// Deletes what [`write()`] left in `folder` when its process was killed. Only for a folder's owner,
/// while nobody writes there.
pub fn remove_partial_files(folder: &Path) -> Result<(), SceneError> {
    let io = |cause| SceneError::io(folder, cause);
    for entry in fs::read_dir(folder).map_err(io)? {
        let entry = entry.map_err(io)?;
        let name = entry.file_name();
        let name = name.to_string_lossy();
        if name.starts_with('.') && name.ends_with(SUFFIX) {
            fs::remove_file(entry.path()).map_err(|cause| SceneError::io(&entry.path(), cause))?;
        }
    }
    Ok(())
}

fn write_and_rename<D: Disk>(
    disk: &D,
    partial: &Path,
    path: &Path,
    fill: impl FnOnce(&mut BufWriter<D::File>) -> io::Result<()>,
) -> io::Result<()> {
    let mut out = BufWriter::with_capacity(BUFFER_BYTES, disk.create(partial)?);
    fill(&mut out)?;
    disk.sync(&out.into_inner().map_err(io::IntoInnerError::into_error)?)?;
    disk.rename(partial, path)?;
    disk.sync_folder(folder_of(path))
}

/// What a disk does, so that a test can cut its power between any two of them.
trait Disk {
    type File: Write;
    fn create(&self, path: &Path) -> io::Result<Self::File>;
    fn sync(&self, file: &Self::File) -> io::Result<()>;
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()>;
    /// Makes a rename in `folder` outlast a power cut.
    fn sync_folder(&self, folder: &Path) -> io::Result<()>;
}

/// The disk of this computer.
struct RealDisk;

impl Disk for RealDisk {
    type File = File;

    fn create(&self, path: &Path) -> io::Result<File> {
        File::create(path)
    }

    fn sync(&self, file: &File) -> io::Result<()> {
        file.sync_all()
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        fs::rename(from, to)
    }

    fn sync_folder(&self, folder: &Path) -> io::Result<()> {
        // Elsewhere folders cannot be opened as files, and renames need no such help.
        if cfg!(unix) { File::open(folder)?.sync_all() } else { Ok(()) }
    }
}

/// A file that is removed when this goes, unless it was renamed away before.
struct Partial(PathBuf);

impl Drop for Partial {
    fn drop(&mut self) {
        // After the rename there is nothing to remove; before it, nothing more can be done.
        let _ = fs::remove_file(&self.0);
    }
}

/// A hidden sibling of `path`, another one for each call and process.
fn partial_path(path: &Path) -> PathBuf {
    static CALLS: AtomicU64 = AtomicU64::new(0);
    let mut name = OsString::from(".");
    name.push(path.file_name().unwrap_or_default());
    name.push(format!(".{}-{}{SUFFIX}", std::process::id(), CALLS.fetch_add(1, Ordering::Relaxed)));
    folder_of(path).join(name)
}

fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

#[cfg(test)]
mod power;

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let names = fs::read_dir(folder).unwrap();
        names.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect()
    }

    #[test]
    fn a_file_is_replaced_whole() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.bin");
        write(&path, |out| out.write_all(b"first")).unwrap();
        write(&path, |out| out.write_all(b"second")).unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"second");
        assert_eq!(names(folder.path()), ["a.bin"]);
    }

    #[test]
    fn a_failed_write_changes_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.bin");
        write(&path, |out| out.write_all(b"good")).unwrap();
        let error = write(&path, |out| {
            out.write_all(&vec![0; 2 * BUFFER_BYTES])?;
            Err(io::ErrorKind::StorageFull.into())
        });
        let text = error.unwrap_err().to_string();
        assert!(text.contains("a.bin") && text.contains("the disk is full"), "{text}");
        assert_eq!(fs::read(&path).unwrap(), b"good");
        assert_eq!(names(folder.path()), ["a.bin"]);
    }

    #[test]
    fn a_missing_folder_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("nowhere").join("a.bin");
        let text = write(&path, |_| Ok(())).unwrap_err().to_string();
        assert!(text.contains("nowhere") && text.contains("no such"), "{text}");
    }

    #[test]
    fn what_a_kill_left_is_swept() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(partial_path(&folder.path().join("a.bin")), b"half").unwrap();
        fs::write(folder.path().join("b.partial"), b"somebody's").unwrap();
        remove_partial_files(folder.path()).unwrap();
        assert_eq!(names(folder.path()), ["b.partial"]);
    }
}
