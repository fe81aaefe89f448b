//! Why models are not merged.

use cosurf_engine::DeviceError;
use cosurf_link::{BodyFault, StoreError};
use cosurf_scene::SceneError;

use crate::queue::QueueError;
use crate::store::ObjectError;

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
    /// The body of a model (its encoded form) is invalid.
    #[error(transparent)]
    Body(#[from] BodyFault),
    /// The result of a tile was not read from its store, or not written there.
    #[error(transparent)]
    Tiles(#[from] ObjectError),
    /// The device is not available, or failed during the merge.
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// The memory limit is too small for one tile of the ground, or for every model.
    #[error("a memory limit of {} MiB is too small; this merge needs at least {1} MiB (--memory {1}MiB; in a mission --merge-memory, in aggregator.toml merge_memory)", memory_bytes >> 20, needed_bytes.div_ceil(1 << 20))]
    TooLittleMemory {
        /// The memory limit, bytes.
        memory_bytes: u64,
        /// The smallest sufficient limit, bytes.
        needed_bytes: u64,
    },
    /// The memory limit is too small for the pictures of some models, whatever else is merged.
    #[error("a memory limit of {} MiB is too small for the largest pictures; they need at least {1} MiB (--memory {1}MiB; in a mission --merge-memory, in aggregator.toml merge_memory)", memory_bytes >> 20, needed_bytes.div_ceil(1 << 20))]
    PicturesTooLarge {
        /// Indices of the models, ascending.
        locals: Vec<usize>,
        /// The memory limit, bytes.
        memory_bytes: u64,
        /// A limit that is sufficient for the pictures, bytes.
        needed_bytes: u64,
    },
    /// The memory limit is too small for some models.
    #[error("a memory limit of {} MiB is too small for the largest models; they need at least {1} MiB (--memory {1}MiB; in a mission --merge-memory, in aggregator.toml merge_memory)", memory_bytes >> 20, needed_bytes.div_ceil(1 << 20))]
    ModelsTooLarge {
        /// Indices of the models, ascending.
        locals: Vec<usize>,
        /// The memory limit, bytes.
        memory_bytes: u64,
        /// A limit that is sufficient for the models, bytes.
        needed_bytes: u64,
    },
    /// The queue of tiles for workers is not available.
    #[error(transparent)]
    Queue(#[from] QueueError),
    /// What a tile is to be distilled from is damaged, or comes from another version of the program.
    #[error(
        "the task of a tile is damaged, or made by another version of cosurf; use the same version everywhere"
    )]
    BadTask,
    /// The task of a tile asks for more than any merge does.
    #[error("the task of a tile is refused: {reason}; check who can write to the place of the tiles")]
    TaskRefused {
        /// What is wrong with it.
        reason: String,
    },
    /// The workers could not distil a tile.
    #[error("the workers failed to distil a tile: {reason}")]
    Workers {
        /// What the last worker said.
        reason: String,
    },
    /// The caller stopped the merge.
    #[error("the merge was stopped")]
    GivenUp,
    /// The merge panicked because of a defect of this program.
    #[error("the merge stopped on an internal error, printed above; please report it. The models are kept")]
    Panicked,
}
