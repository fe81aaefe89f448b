//! What can be wrong with files from outside: one line each, naming the thing and the remedy.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

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
        /// What the operating system said.
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
