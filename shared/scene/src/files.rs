//! Files that may be damaged, or that may not be files at all. A program that reads what an earlier run left must not wait
//! for a writer of a FIFO, and must not end because of one bad file.

use std::ffi::OsString;
use std::fs::{self, File};
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use crate::{SceneError, check_space};

/// Damaged files of one name that are kept.
const KEPT_MAX: u32 = 100;

/// The folder of a dataset or model that is named by its folder or by a file in it.
pub fn folder_of(path: &Path) -> &Path {
    if path.is_file() { path.parent().unwrap_or(path) } else { path }
}

/// Creates a folder and those above it, unless they are there. What is in the way is not set aside: a link that leads nowhere
/// may lead to a disk that is to be mounted.
pub fn create_folder(folder: &Path) -> Result<(), SceneError> {
    let Err(cause) = fs::create_dir_all(folder) else { return Ok(()) };
    let is_in_the_way = |path: &&Path| path.symlink_metadata().is_ok() && !path.is_dir();
    Err(match folder.ancestors().find(is_in_the_way) {
        Some(link) if link.is_symlink() && !link.exists() => SceneError::malformed(
            link,
            "is a link to a folder that is not there; mount its disk, remove the link, or name another folder",
        ),
        Some(file) => SceneError::malformed(file, "is not a folder; move it away, or name another folder"),
        None if cause.kind() == io::ErrorKind::NotFound => {
            SceneError::malformed(folder, "cannot be created there; name another folder")
        }
        None => SceneError::io(folder, cause),
    })
}

/// Opens a regular file for reading. Fails if the path is a folder, a FIFO, a device, or a link that leads nowhere; to open a
/// FIFO would wait for its writer.
pub fn open(path: &Path) -> Result<File, SceneError> {
    let failed = |cause| SceneError::io(path, cause);
    let kind = fs::metadata(path).map_err(|cause| match path.is_symlink() {
        true => SceneError::malformed(path, format!("is a link that leads nowhere ({cause})")),
        false => failed(cause),
    })?;
    if !kind.is_file() {
        let fault = if kind.is_dir() { "is a folder, not a file" } else { "is not a file" };
        return Err(SceneError::malformed(path, fault));
    }
    File::open(path).map_err(failed)
}

/// Reads a regular file as [`open`] opens it.
pub fn read(path: &Path) -> Result<Vec<u8>, SceneError> {
    let mut bytes = Vec::new();
    open(path)?.read_to_end(&mut bytes).map_err(|cause| SceneError::io(path, cause))?;
    Ok(bytes)
}

/// The path itself, or the file of that name whose extension is in upper or in lower case, if only that exists: `a.JPG` for
/// `a.jpg`.
pub(crate) fn in_any_case(path: PathBuf) -> PathBuf {
    let Some(extension) = path.extension().and_then(|extension| extension.to_str()) else { return path };
    if path.is_file() {
        return path;
    }
    let others = [extension.to_ascii_uppercase(), extension.to_ascii_lowercase()];
    let other = others.iter().map(|extension| path.with_extension(extension)).find(|path| path.is_file());
    other.unwrap_or(path)
}

/// Whether an error means that the file itself is of no use: it is damaged, no file, or not ours to read. Other errors,
/// such as too many open files, say nothing about the file.
pub fn is_damage(error: &SceneError) -> bool {
    match error {
        SceneError::Malformed { .. } => true,
        SceneError::Io { cause, .. } => {
            matches!(
                cause.kind(),
                io::ErrorKind::UnexpectedEof
                    | io::ErrorKind::PermissionDenied
                    | io::ErrorKind::InvalidData
                    | io::ErrorKind::IsADirectory
            )
        }
        SceneError::OverBudget { .. }
        | SceneError::InUse { .. }
        | SceneError::OfAnother { .. }
        | SceneError::DiskFull { .. } => false,
    }
}

/// Whether an error means that the disk is full, so that the same may succeed later.
pub fn is_full_disk(error: &SceneError) -> bool {
    match error {
        SceneError::Io { cause, .. } => {
            matches!(cause.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded)
        }
        SceneError::DiskFull { .. } => true,
        _ => false,
    }
}

/// The error of a write of so many bytes into `folder`. That of a full disk tells how much is free and needed, unless there is room
/// again.
pub fn with_space(error: SceneError, folder: &Path, needed_bytes: u64) -> SceneError {
    match is_full_disk(&error) {
        true => check_space(folder, needed_bytes).err().unwrap_or(error),
        false => error,
    }
}

/// Renames a folder, a FIFO or a device that has the path of a file, so that the file can be written. Returns the new path.
pub fn set_aside_unless_file(path: &Path) -> Result<Option<PathBuf>, SceneError> {
    let is_there = fs::symlink_metadata(path).is_ok();
    (is_there && !path.is_file()).then(|| set_aside(path)).transpose()
}

/// Renames a file, or whatever has its name, so that it no longer counts: `a.json` becomes `a.damaged`, or `a.damaged-2` if
/// that exists. Returns the new path.
pub fn set_aside(path: &Path) -> Result<PathBuf, SceneError> {
    let name = |number: u32| {
        let suffix = if number == 1 { OsString::new() } else { OsString::from(format!("-{number}")) };
        let mut extension = OsString::from("damaged");
        extension.push(suffix);
        path.with_extension(extension)
    };
    let free = (1..=KEPT_MAX).map(name).find(|path| fs::symlink_metadata(path).is_err());
    let free = free.ok_or_else(|| {
        SceneError::malformed(path, format!("cannot be set aside: remove some of {}*", name(1).display()))
    })?;
    fs::rename(path, &free).map_err(|cause| SceneError::io(path, cause))?;
    Ok(free)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn damaged_files_of_one_name_are_all_kept() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.json");
        for name in ["a.damaged", "a.damaged-2", "a.damaged-3"] {
            fs::write(&path, name).unwrap();
            assert_eq!(set_aside(&path).unwrap(), folder.path().join(name));
        }
        fs::create_dir(&path).unwrap();
        assert!(is_damage(&read(&path).unwrap_err()), "a folder");
        assert!(set_aside(&path).unwrap().is_dir());
        assert!(!is_damage(&read(&path).unwrap_err()), "a missing file is not damaged");
        assert_eq!(fs::read(folder.path().join("a.damaged-2")).unwrap(), b"a.damaged-2");
    }

    #[test]
    fn what_is_in_the_way_of_a_folder_is_named_and_stays() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        fs::write(&file, "x").unwrap();
        let fault = |path: &Path| create_folder(path).unwrap_err().to_string();
        let words = format!("{}: is not a folder; move it away, or name another folder", file.display());
        assert_eq!([fault(&file), fault(&file.join("a/b"))], [words.clone(), words]);
        create_folder(&folder.path().join("a/b")).unwrap();
        create_folder(&folder.path().join("a")).unwrap();
        #[cfg(unix)]
        {
            let link = folder.path().join("link");
            std::os::unix::fs::symlink("unmounted", &link).unwrap();
            assert!(
                fault(&link.join("global")).contains("link: is a link to a folder that is not there; mount")
            );
            assert!(link.is_symlink());
        }
    }

    #[cfg(unix)]
    #[test]
    fn a_link_that_leads_nowhere_is_damage() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.json");
        for target in ["missing", "a.json"] {
            std::os::unix::fs::symlink(target, &path).unwrap();
            let error = read(&path).unwrap_err();
            assert!(is_damage(&error) && error.to_string().contains("leads nowhere"), "{error}");
            let kept = set_aside_unless_file(&path).unwrap().unwrap();
            assert!(kept.is_symlink() && !path.is_symlink());
        }
        assert!(set_aside_unless_file(&path).unwrap().is_none(), "nothing is there");
    }
}
