//! Errors of reading and writing files. Each is one line that names the file and the remedy.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

use crate::bytes::format_bytes;

/// An error of reading or writing a scene.
///
/// `Display` gives the complete message in one line; there is no `source`.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SceneError {
    /// The operating system could not read or write the file.
    #[error("{}: {}", path.display(), InWords(cause))]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// The operating system's error.
        cause: io::Error,
    },
    /// The file's content violates its format, or the format cannot hold what was to be written.
    #[error("{}: {reason}", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// The fault and its remedy, one line.
        reason: String,
    },
    /// A memory budget is too small for the pictures.
    #[error("the pictures need {}, but their memory budget is {}; raise the budget or use smaller pictures", format_bytes(*needed_bytes), format_bytes(*budget_bytes))]
    OverBudget {
        /// The least budget that suffices.
        needed_bytes: u64,
        /// The given budget.
        budget_bytes: u64,
    },
}

impl SceneError {
    /// An operating system's error about `path`.
    pub fn io(path: &Path, cause: io::Error) -> Self {
        Self::Io { path: path.to_owned(), cause }
    }

    /// An error in the content of `path`; `reason` is one line that also gives the remedy.
    pub fn malformed(path: &Path, reason: impl Into<String>) -> Self {
        Self::Malformed { path: path.to_owned(), reason: reason.into() }
    }
}

/// A parser's error that does not name the file yet; [`Refusal::of`] adds the path.
#[derive(Debug)]
pub(crate) enum Refusal {
    /// The operating system failed, or the file ends too early.
    Io(io::Error),
    /// The content is invalid; one line.
    Content(String),
}

impl Refusal {
    /// The error with the path of the file.
    pub(crate) fn of(self, path: &Path) -> SceneError {
        match self {
            Self::Io(cause) => SceneError::io(path, cause),
            Self::Content(reason) => SceneError::malformed(path, reason),
        }
    }

    /// Prepends the place in the file where the error occurred, for example `row 3 of 8`.
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

/// Displays an operating system's error, with a remedy for the common kinds.
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
