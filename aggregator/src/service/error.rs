//! Why a service failed.

use cosurf_link::{BodyFault, StoreError};
use cosurf_scene::SceneError;

use crate::merge::MergeError;

/// Why a service failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ServiceError {
    /// A model could not be written or read.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A file beside the models could not be written, for example the PLY file of the global model.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The body of a model is invalid.
    #[error("the body of a model is invalid: {0}")]
    Body(#[from] BodyFault),
    /// The merge failed.
    #[error(transparent)]
    Merge(#[from] MergeError),
}
