//! Errors of reading and writing files. Each message is one line: the file if the error concerns
//! one, the fault, and a remedy where one is known.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

use crate::bytes::format_bytes;

/// An error of reading or writing a scene.
///
/// `Display` gives the complete message in one line. `source()` is always `None`.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SceneError {
    /// Reading or writing the file or folder failed.
    #[error("{}: {}", path.display(), InWords(cause))]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// The underlying error, usually the operating system's.
        cause: io::Error,
    },
    /// The content of a file or folder is invalid, or a file format cannot hold what should be
    /// written.
    #[error("{}: {reason}", path.display())]
    Malformed {
        /// The file or folder.
        path: PathBuf,
        /// One line: the fault, and a remedy where one is known.
        reason: String,
    },
    /// A memory budget is too small for the pictures.
    #[error("the pictures need {}, but their memory budget is {}; raise the budget or use smaller pictures", format_bytes(*needed_bytes), format_bytes(*budget_bytes))]
    OverBudget {
        /// Smallest budget that suffices, bytes.
        needed_bytes: u64,
        /// The given budget, bytes.
        budget_bytes: u64,
    },
    /// Another process writes to the folder.
    #[error("{}: in use by {holder}; stop it, or name another folder", folder.display())]
    InUse {
        /// The folder.
        folder: PathBuf,
        /// The program and the number of the process, in words.
        holder: String,
    },
    /// The folder has results of a program of another kind; they would be replaced.
    #[error("{}: holds what {program} wrote; name another folder", folder.display())]
    OfAnother {
        /// The folder.
        folder: PathBuf,
        /// The other program, in words.
        program: &'static str,
    },
    /// Too little can be written to the disk.
    #[error("{}: this disk has {} free, at least {} are needed; free some, or name a folder on another disk", folder.display(), format_bytes(*free_bytes), format_bytes(*needed_bytes))]
    DiskFull {
        /// The folder that should be written to.
        folder: PathBuf,
        /// What can be written to its disk, bytes.
        free_bytes: u64,
        /// What will be written at least, bytes.
        needed_bytes: u64,
    },
}

impl SceneError {
    /// The error for `cause`, which happened while `path` was read or written.
    pub fn io(path: &Path, cause: io::Error) -> Self {
        Self::Io { path: path.to_owned(), cause }
    }

    /// The error for invalid content of `path`. `reason` is one line: the fault, and a remedy where one
    /// is known.
    pub fn malformed(path: &Path, reason: impl Into<String>) -> Self {
        Self::Malformed { path: path.to_owned(), reason: reason.into() }
    }
}

/// A parser's error that does not name the file yet; [`Refusal::of`] adds the path.
#[derive(Debug)]
pub(crate) enum Refusal {
    /// The operating system failed, or the file ends too early.
    Io(io::Error),
    /// The content is invalid, for the reason given in one line.
    Content(String),
}

impl Refusal {
    /// Adds the path of the file to the error.
    pub(crate) fn of(self, path: &Path) -> SceneError {
        match self {
            Self::Io(cause) => SceneError::io(path, cause),
            Self::Content(reason) => SceneError::malformed(path, reason),
        }
    }

    /// Adds the place in the file where the error occurred, for example `row 3 of 8`. An I/O error
    /// other than an early end of the file stays as it is.
    pub(crate) fn at(self, place: impl fmt::Display) -> Self {
        match self {
            Self::Io(cause) if cause.kind() == io::ErrorKind::UnexpectedEof => {
                Self::Content(format!("ends within {place}; the file was cut short, fetch it again"))
            }
            Self::Content(reason) => Self::Content(format!("{place}: {reason}")),
            other => other,
        }
    }
}

impl From<io::Error> for Refusal {
    fn from(error: io::Error) -> Self {
        Self::Io(error)
    }
}

impl From<String> for Refusal {
    fn from(reason: String) -> Self {
        Self::Content(reason)
    }
}

impl From<&str> for Refusal {
    fn from(reason: &str) -> Self {
        Self::Content(reason.into())
    }
}

/// Displays an I/O error. The common kinds get a plainer text than the operating system's.
struct InWords<'a>(&'a io::Error);

impl fmt::Display for InWords<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0.kind() {
            io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => {
                write!(f, "the disk is full; free some space or choose another folder")
            }
            io::ErrorKind::NotFound => write!(f, "there is no such file or folder"),
            io::ErrorKind::PermissionDenied => {
                write!(f, "permission denied; change its owner or mode, or choose another folder")
            }
            io::ErrorKind::UnexpectedEof => {
                write!(f, "the file ends too early; it was cut short, fetch it again")
            }
            _ => write!(f, "{}", self.0),
        }
    }
}
