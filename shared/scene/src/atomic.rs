//! Atomic writes. The content is written to a temporary file in the folder of the final path and
//! synced to the disk; then the file is renamed to the final path. So after a full disk, a kill or a
//! power cut, the path holds the last complete version (or none), never part of a new one.

use std::ffi::OsString;
use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use crate::SceneError;
use crate::files::{self, is_full_disk};

/// Size of the write buffer, bytes; a larger buffer brings no measurable gain.
const BUFFER_BYTES: usize = 256 * 1024;

/// Suffix of temporary files.
const SUFFIX: &str = ".partial";

/// Lets `fill` write the content of `path`, atomically and durably. After `Ok` the content is on the
/// disk. After an error no temporary file remains, and `path` is unchanged. Exception: if the last step
/// failed, the sync of the folder, `path` already has the new content. The folder must exist. If several
/// threads or processes write one path, the last to finish wins.
pub fn write(
    path: &Path,
    fill: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>,
) -> Result<(), SceneError> {
    let partial = Partial(partial_path(path));
    write_and_rename(&RealDisk, &partial.0, path, fill).map_err(|cause| SceneError::io(path, cause))
}

/// Fails if [`write()`] would fail now: call it before the work whose result is to be written.
pub fn check(path: &Path) -> Result<(), SceneError> {
    if path.is_dir() {
        return Err(SceneError::malformed(path, "is a folder; name a file"));
    }
    let partial = Partial(partial_path(path));
    RealDisk.create(&partial.0).map(drop).map_err(|cause| SceneError::io(path, cause))
}

/// Makes a folder, and those above it, unless they are there. Fails if this program may not create files in it.
pub fn prepare_folder(folder: &Path) -> Result<(), SceneError> {
    files::create_folder(folder)?;
    check_folder(folder)
}

/// Fails if this program may not create files in the folder. A full disk is no failure: it may have room later.
pub(crate) fn check_folder(folder: &Path) -> Result<(), SceneError> {
    let partial = Partial(partial_path(&folder.join("check")));
    match RealDisk.create(&partial.0).map_err(|cause| SceneError::io(folder, cause)) {
        Err(error) if !is_full_disk(&error) => Err(error),
        _ => Ok(()),
    }
}

/// As [`write()`], with a content that is in memory.
pub fn write_bytes(path: &Path, content: &[u8]) -> Result<(), SceneError> {
    write_sized(path, content.len() as u64, |file| file.write_all(content))
}

/// As [`write()`], with a content of so many bytes. If the disk is too full for it, the error tells how much is free.
pub fn write_sized(
    path: &Path,
    content_bytes: u64,
    fill: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>,
) -> Result<(), SceneError> {
    write(path, fill).map_err(|error| files::with_space(error, folder_of(path), content_bytes))
}

/// Deletes the temporary files that remain in `folder` if a process was killed during [`write()`]. No
/// thread or process may call [`write()`] in this folder at the same time.
pub fn remove_partial_files(folder: &Path) -> Result<(), SceneError> {
    let io = |cause| SceneError::io(folder, cause);
    for entry in fs::read_dir(folder).map_err(io)? {
        let entry = entry.map_err(io)?;
        let name = entry.file_name();
        let name = name.to_string_lossy();
        // Only files are left behind by a write.
        let is_file = entry.file_type().is_ok_and(|kind| !kind.is_dir());
        if is_file && name.starts_with('.') && name.ends_with(SUFFIX) {
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

/// The operations of a disk. It is a trait so that a test can cut the power between any two
/// operations.
trait Disk {
    type File: Write;
    fn create(&self, path: &Path) -> io::Result<Self::File>;
    fn sync(&self, file: &Self::File) -> io::Result<()>;
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()>;
    /// Makes renames in `folder` survive a power cut.
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
        // Systems other than Unix cannot open folders as files, and their renames need no sync.
        if cfg!(unix) { File::open(folder)?.sync_all() } else { Ok(()) }
    }
}

/// A temporary file, which is removed on drop unless it was renamed before.
struct Partial(PathBuf);

impl Drop for Partial {
    fn drop(&mut self) {
        // After the rename there is nothing to remove, so this fails. Other failures cannot be mended
        // here.
        let _ = fs::remove_file(&self.0);
    }
}

/// Path of a hidden file in the folder of `path`, with a name that no other call or process uses.
fn partial_path(path: &Path) -> PathBuf {
    static CALLS: AtomicU64 = AtomicU64::new(0);
    let mut name = OsString::from(".");
    name.push(path.file_name().unwrap_or_default());
    name.push(format!(".{}-{}{SUFFIX}", std::process::id(), CALLS.fetch_add(1, Ordering::Relaxed)));
    folder_of(path).join(name)
}

/// The folder in which a file with this path lies.
pub fn folder_of(path: &Path) -> &Path {
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
    fn a_file_is_replaced_by_its_next_version() {
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
    #[cfg(unix)]
    fn a_full_disk_tells_how_much_is_needed_and_free() {
        let folder = tempfile::tempdir().unwrap();
        let full = |_: &mut BufWriter<File>| Err(io::ErrorKind::StorageFull.into());
        let text = write_sized(&folder.path().join("a.bin"), 1 << 60, full).unwrap_err().to_string();
        assert!(text.contains(" free, at least ") && text.contains("are needed"), "{text}");
        // The space may have been freed since, or belongs to others.
        let text = write_sized(&folder.path().join("a.bin"), 0, full).unwrap_err().to_string();
        assert!(text.contains("a.bin: the disk is full"), "{text}");
        let other = |_: &mut BufWriter<File>| Err(io::ErrorKind::PermissionDenied.into());
        let text = write_sized(&folder.path().join("a.bin"), 1 << 60, other).unwrap_err().to_string();
        assert!(text.contains("permission denied"), "{text}");
    }

    #[test]
    fn a_missing_folder_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("nowhere").join("a.bin");
        let text = write(&path, |_| Ok(())).unwrap_err().to_string();
        assert_eq!(check(&path).unwrap_err().to_string(), text);
        assert!(text.contains("nowhere") && text.contains("no such"), "{text}");
    }

    #[test]
    fn a_check_leaves_nothing() {
        let folder = tempfile::tempdir().unwrap();
        check(&folder.path().join("a.bin")).unwrap();
        assert!(names(folder.path()).is_empty());
        assert!(check(folder.path()).unwrap_err().to_string().ends_with("is a folder; name a file"));
        prepare_folder(folder.path()).unwrap();
        assert!(names(folder.path()).is_empty());
        if cfg!(target_os = "linux") {
            let error = prepare_folder(Path::new("/proc/self")).unwrap_err().to_string();
            assert!(error.starts_with("/proc/self: "), "{error}");
        }
    }

    #[test]
    fn temporary_files_of_a_killed_process_are_removed() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(partial_path(&folder.path().join("a.bin")), b"half").unwrap();
        fs::write(folder.path().join("b.partial"), b"somebody's").unwrap();
        remove_partial_files(folder.path()).unwrap();
        assert_eq!(names(folder.path()), ["b.partial"]);
    }
}
