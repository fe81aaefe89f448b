//! Why the ground station does not run.

use std::io;
use std::net::SocketAddr;
use std::path::PathBuf;

/// Why the ground station does not run.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StationError {
    /// The address cannot be bound.
    #[error("--http {address}: {cause}; give another address or port, for example 127.0.0.1:0")]
    Address {
        /// The address.
        address: SocketAddr,
        /// The system's reason.
        cause: io::Error,
    },
    /// The threads of the server could not be started.
    #[error("the HTTP server cannot start: {0}")]
    Threads(io::Error),
    /// No random token can be drawn.
    #[error("the system gives no random bytes for a token; name a file with --http-token-file")]
    NoRandom,
    /// The file of the token cannot be read.
    #[error("{}: {cause}", path.display())]
    TokenFile {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        cause: io::Error,
    },
    /// The file holds no usable token.
    #[error(
        "{}: the first line must be a token of 16 to 128 letters, digits, hyphens and underscores, for example of \
         `openssl rand -hex 16`", path.display()
    )]
    WeakToken {
        /// The file.
        path: PathBuf,
    },
}
