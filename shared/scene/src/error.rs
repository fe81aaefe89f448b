//! What can be wrong with files from outside: one line each, naming the thing and the remedy.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

use crate::bytes::format_bytes;

/// An error of reading or writing a scene.
///
/// `Display` says all there is to say in one line; there is no further `source`.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SceneError {
    /// The operating system refused.
    #[error("{}: {}", path.display(), InWords(cause))]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// The error of the operating system.
        cause: io::Error,
    },
    /// The file's content is not what its format promises.
    #[error("{}: {reason}", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// What is wrong and what mends it, one line.
        reason: String,
    },
    /// A memory budget is too small for the pictures.
    #[error("the pictures need {}, but have {}; allow more memory or smaller pictures", format_bytes(*needed_bytes), format_bytes(*budget_bytes))]
    OverBudget {
        /// The least that would do.
        needed_bytes: u64,
        /// What was given.
        budget_bytes: u64,
    },
}

impl SceneError {
    /// The operating system's refusal of `path`.
    pub fn io(path: &Path, cause: io::Error) -> Self {
        Self::Io { path: path.to_owned(), cause }
    }

    /// A complaint about the content of `path`, one line that also says what mends it.
    pub fn malformed(path: &Path, reason: impl Into<String>) -> Self {
        Self::Malformed { path: path.to_owned(), reason: reason.into() }
    }
}

/// Why a file cannot be read, said by a parser that does not know the file's path.
#[derive(Debug)]
pub(crate) enum Refusal {
    /// The operating system failed, or the file ends too early.
    Io(io::Error),
    /// The content is wrong; one line.
    Content(String),
}

impl Refusal {
    /// The same, of the file at `path`.
    pub(crate) fn of(self, path: &Path) -> SceneError {
        match self {
            Self::Io(cause) => SceneError::io(path, cause),
            Self::Content(reason) => SceneError::malformed(path, reason),
        }
    }

    /// The same, with the place in the file where it happened, for example `row 3 of 8`.
    pub(crate) fn at(self, place: impl fmt::Display) -> Self {
        match self {
            Self::Io(cause) if cause.kind() == io::ErrorKind::UnexpectedEof => {
                Self::Content(format!("ends within {place}; it was cut short, fetch it again"))
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

/// An operating system's error with its remedy where there is a plain one.
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
