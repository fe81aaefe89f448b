//! Why there is no model for the viewer.

use std::path::PathBuf;

use cosurf_geo::GeoError;
use cosurf_link::{BodyFault, StoreError};
use cosurf_scene::SceneError;

/// Why there is no model for the viewer.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WalkableError {
    /// The model or its cameras cannot be read.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The georeference cannot be read.
    #[error(transparent)]
    Geo(#[from] GeoError),
    /// The model has no splats, or no splat fits into the memory.
    #[error("{}: no splats to show", path.display())]
    Nothing {
        /// The file.
        path: PathBuf,
    },
    /// A revision is too large to be read within the memory.
    #[error("{}: {splats} splats take too much memory to show", path.display())]
    TooLarge {
        /// The folder of the revision.
        path: PathBuf,
        /// Number of its splats.
        splats: usize,
    },
    /// A stored revision cannot be read.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A stored revision cannot be decoded.
    #[error("{}: {fault}", path.display())]
    Body {
        /// The folder of the revision.
        path: PathBuf,
        /// What is wrong.
        fault: BodyFault,
    },
    /// SPZ, the viewer's format, cannot hold the positions.
    #[error("{}: coordinates beyond 8,388,607 cannot be shown; move the model nearer to its origin", path.display())]
    TooFar {
        /// The file.
        path: PathBuf,
    },
}
