//! How models are merged.

use cosurf_engine::DeviceChoice;
use serde::{Deserialize, Serialize};

/// How models are merged.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct MergeSettings {
    /// Epochs of distillation, each over every camera (CoSurfGS: 5); 0 leaves the joined model as it is.
    pub epochs: u32,
    /// Whether overlaps are first reduced to the splats of one model (Local Model Compression).
    pub compress: bool,
    /// Whether models in another frame are moved to where they fit instead of being kept out; see [`crate::gate`].
    pub refine: bool,
    /// Limit on the bytes of the models and their training together. If it is too small for all at once, teachers wait
    /// on the disk and parts of the model are distilled one after the other, which changes the result.
    pub memory_bytes: u64,
    /// Seed of every random choice.
    pub seed: u64,
    /// What computes; another device gives other bytes.
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
