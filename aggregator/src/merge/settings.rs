//! How models are merged.

use cosurf_engine::DeviceChoice;
use serde::{Deserialize, Serialize};

/// How models are merged.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct MergeSettings {
    /// Times that every camera is learnt from (CoSurfGS: 5); 0 leaves the models as they were joined.
    pub epochs: u32,
    /// Whether what several models show is left to one of them first.
    pub compress: bool,
    /// Whether models that lie in another frame than the others are moved to where they fit, rather than kept out; see
    /// [`crate::gate`].
    pub refine: bool,
    /// Bytes that the models and their training may take together. Where they do not suffice for all at once,
    /// teachers wait on the disk and the cells are distilled one after the other; that changes the result.
    pub memory_bytes: u64,
    /// Seed of every random choice.
    pub seed: u64,
    /// What computes; the same bytes are those of one device.
    #[serde(default)]
    pub device: DeviceChoice,
}

impl Default for MergeSettings {
    fn default() -> Self {
        Self {
            epochs: 5,
            compress: true,
            refine: false,
            memory_bytes: 4 << 30,
            seed: 0,
            device: DeviceChoice::Auto,
        }
    }
}
