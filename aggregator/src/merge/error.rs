//! Why models are not merged.

use cosurf_engine::DeviceError;
use cosurf_link::{BodyFault, StoreError};
use cosurf_scene::SceneError;

/// Why models are not merged.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MergeError {
    /// A model could not be read from its store.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A model could not be read from its folder.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// A model is not what it should be.
    #[error(transparent)]
    Body(#[from] BodyFault),
    /// What was to compute cannot, or could not to the end.
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// The owner said stop.
    #[error("the merge was given up")]
    GivenUp,
}
