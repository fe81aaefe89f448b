//! Why a service cannot work.

use cosurf_link::{BodyFault, StoreError};
use cosurf_scene::SceneError;

use crate::merge::MergeError;

/// Why a service cannot work.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ServiceError {
    /// A model could not be written or read.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The PLY could not be written.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The models cannot be one.
    #[error("the models cannot be joined: {0}")]
    Body(#[from] BodyFault),
    /// The models are not merged.
    #[error(transparent)]
    Merge(#[from] MergeError),
}
