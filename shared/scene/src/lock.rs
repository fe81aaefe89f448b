//! Keeps two programs from writing to one folder.

use std::fs::{File, OpenOptions, TryLockError};
use std::io::{ErrorKind, Read, Seek, Write};
use std::path::Path;

use crate::{SceneError, atomic, files};

/// The file in the folder that is locked. It stays when the lock is gone.
const NAME: &str = "lock";
/// Length of the name of a holder, up to which it is read, bytes.
const HOLDER_BYTES_MAX: u64 = 200;
/// The kinds of programs that write results, and what messages call them. Programs of different kinds write different contents
/// to files of the same names, so a folder belongs to one kind.
const KINDS: [(&[&str], &str); 4] = [
    (
        &["cosurf-agent train", "cosurf-agent run", "cosurf-agent preflight", "cosurf-agent doctor"],
        "a training",
    ),
    (&["cosurf-aggregator merge"], "cosurf-aggregator merge"),
    (&["cosurf-aggregator mission"], "cosurf-aggregator mission"),
    (&["cosurf-aggregator run", "cosurf-aggregator doctor"], "cosurf-aggregator run"),
];
/// A folder with one of these files has results.
const RESULTS: [&str; 5] = ["cameras.json", "global.ply", "merged.json", "model.ply", "report.json"];

/// The right to write to a folder. It ends when this value is dropped, or when the process ends in any way.
#[derive(Debug)]
pub struct FolderLock {
    file: File,
}

impl Drop for FolderLock {
    /// A program that is just being started by another thread has a copy of the file until it runs, and would keep the lock.
    fn drop(&mut self) {
        let _ = self.file.unlock();
    }
}

impl FolderLock {
    /// Creates the folder and takes the lock. Others who want it are told `program` and the number of this process. Fails
    /// with [`SceneError::InUse`] if somebody else has it, with [`SceneError::OfAnother`] if the folder has results of a
    /// program of another kind, and with another error if this program may not create files in the folder. Where the file
    /// system cannot lock files, nobody is kept out. Deletes unfinished files of killed programs.
    pub fn take(folder: &Path, program: &str) -> Result<Self, SceneError> {
        files::create_folder(folder)?;
        let path = folder.join(NAME);
        let failed = |cause| SceneError::io(&path, cause);
        files::set_aside_unless_file(&path)?; // nobody can have locked what is no file
        let mut options = OpenOptions::new();
        let mut file =
            options.create(true).truncate(false).read(true).write(true).open(&path).map_err(failed)?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                return Err(SceneError::InUse { folder: folder.to_owned(), holder: holder(&file) });
            }
            Err(TryLockError::Error(cause)) if cause.kind() == ErrorKind::Unsupported => {}
            Err(TryLockError::Error(cause)) => return Err(failed(cause)),
        }
        if let (Some(earlier), Some(now)) = (kind(&holder(&file)), kind(program))
            && earlier != now
            && RESULTS.iter().any(|name| folder.join(name).exists())
        {
            return Err(SceneError::OfAnother { folder: folder.to_owned(), program: earlier });
        }
        // The name only serves others; the lock holds without it, on a full disk too.
        let _ = file.set_len(0).and_then(|()| file.rewind());
        let _ = write!(file, "{program}, process {}", std::process::id());
        atomic::remove_partial_files(folder)?;
        atomic::check_folder(folder)?;
        Ok(Self { file })
    }
}

/// The kind of the program that a holder's name begins with; `None` if it is none of [`KINDS`].
fn kind(holder: &str) -> Option<&'static str> {
    let program = holder.split(',').next().unwrap_or(holder);
    KINDS.iter().find(|(programs, _)| programs.contains(&program)).map(|(_, kind)| *kind)
}

/// Who holds the lock on a file, or has held it last.
fn holder(file: &File) -> String {
    let mut text = String::new();
    let is_read = Read::take(file, HOLDER_BYTES_MAX).read_to_string(&mut text).is_ok();
    let is_clean = is_read && !text.is_empty() && !text.contains(char::is_control);
    if is_clean { text } else { "another process".into() }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::fs;

    use super::*;

    #[test]
    fn a_second_program_is_told_who_uses_the_folder() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("out");
        let first = FolderLock::take(&out, "cosurf-agent run").unwrap();
        let error = FolderLock::take(&out, "cosurf-agent train").unwrap_err().to_string();
        let holder = format!("cosurf-agent run, process {}", std::process::id());
        assert!(error.contains(&holder) && error.contains("another folder"), "{error}");
        drop(first);
        fs::write(out.join(".model.ply.77-0.partial"), "part of a file").unwrap();
        FolderLock::take(&out, "cosurf-agent train").unwrap();
        assert_eq!(fs::read_dir(&out).unwrap().count(), 1, "only the lock");
    }

    #[test]
    fn results_of_a_program_of_another_kind_stay() {
        let folder = tempfile::tempdir().unwrap();
        let take = |program: &str| FolderLock::take(folder.path(), program).map(drop);
        take("cosurf-aggregator mission").unwrap();
        take("cosurf-agent train").unwrap(); // the mission has left nothing
        fs::write(folder.path().join("model.ply"), "ply").unwrap();
        for _ in 0..2 {
            let error = take("cosurf-aggregator mission").unwrap_err().to_string();
            assert!(error.ends_with("holds what a training wrote; name another folder"), "{error}");
        }
        for program in ["cosurf-agent run", "cosurf-agent preflight", "another", "cosurf-aggregator run"] {
            take(program).unwrap(); // after an unknown one, nobody knows whose results these are
        }
        assert!(take("cosurf-aggregator merge").is_err());
    }

    #[test]
    fn what_cannot_be_a_folder_is_told() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("model.ply");
        fs::write(&file, "x").unwrap();
        for (out, fault) in [(file.clone(), "model.ply: is not a folder"), (file.join("out"), "not a folder")]
        {
            let error = FolderLock::take(&out, "a").unwrap_err().to_string();
            assert!(error.contains(fault) && error.contains("name another folder"), "{error}");
        }
        if cfg!(target_os = "linux") {
            let error = FolderLock::take(Path::new("/proc/out"), "a").unwrap_err().to_string();
            assert_eq!(error, "/proc/out: cannot be created there; name another folder");
        }
    }

    #[test]
    fn a_lock_without_a_holders_name_is_told_in_one_line_and_what_is_no_file_is_set_aside() {
        let folder = tempfile::tempdir().unwrap();
        let lock = FolderLock::take(folder.path(), "a\nb").unwrap();
        let error = FolderLock::take(folder.path(), "b").unwrap_err().to_string();
        assert!(error.contains("another process") && !error.contains('\n'), "{error}");
        drop(lock);
        fs::remove_file(folder.path().join(NAME)).unwrap();
        fs::create_dir(folder.path().join(NAME)).unwrap();
        let _lock = FolderLock::take(folder.path(), "b").unwrap();
        assert!(FolderLock::take(folder.path(), "c").is_err());
        assert!(folder.path().join("lock.damaged").is_dir());
    }
}
