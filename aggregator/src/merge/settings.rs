//! How models are merged.

use std::sync::mpsc::Sender;
use std::time::Duration;

use cosurf_engine::DeviceChoice;
use serde::{Deserialize, Serialize};

use crate::queue::Queue;
use crate::store::Store;

/// The workers of a merge. If no result comes from them for too long, the merge distils tiles itself.
#[derive(Clone, Copy, Debug)]
pub struct Workers<'a> {
    /// Where tasks and results are.
    pub store: &'a Store,
    /// Where the workers wait for tasks.
    pub queue: &'a Queue,
    /// The shortest time without a result that is too long: [`Self::PATIENCE`], or less in tests.
    pub patience: Duration,
    /// Gets a line for each trouble with a tile.
    pub say: &'a Sender<String>,
}

impl Workers<'_> {
    /// The usual [`Self::patience`].
    pub const PATIENCE: Duration = Duration::from_secs(60);
}

/// Who distils the tiles of a merge, and where their results are kept. It does not change the result.
#[derive(Clone, Copy, Debug)]
pub enum Tiles<'a> {
    /// This computer; no result is kept.
    Forgotten,
    /// This computer. Results are kept for later merges.
    Kept(&'a Store),
    /// Workers that use the same store and the same queue; see [`crate::worker`].
    ByWorkers(Workers<'a>),
}

impl Tiles<'_> {
    /// Where results are kept.
    pub(super) fn store(&self) -> Option<&Store> {
        match self {
            Self::Forgotten => None,
            Self::Kept(store) | Self::ByWorkers(Workers { store, .. }) => Some(store),
        }
    }
}

/// How models are merged.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct MergeSettings {
    /// Epochs of distillation; each trains once on every camera. 0 leaves the joined model as it is. CoSurfGS has 5
    /// epochs too; 7 epochs with two thirds of the learning rates gave 0.04 dB more on rendered Boruszyn. 8 epochs gave 0.14 dB
    /// more on the town and nothing on two parts of Caliterra; the merge takes 1.4 times as long.
    pub epochs: u32,
    /// Whether only one model keeps its splats where models overlap (Local Model Compression).
    pub compress: bool,
    /// Whether models are moved so that the ground they share lies at the same place in all of them; see
    /// [`crate::gate`].
    pub refine: bool,
    /// Whether all models are known to lie in one world frame. Then a model that shares no ground with the others takes
    /// part too; otherwise it is kept out, because its frame may be another one.
    #[serde(default)]
    pub vouched: bool,
    /// Limit on the bytes of a merge. It decides how many models are compared at once, and how many tiles of the ground
    /// are planned and distilled at once. It does not change the result. A limit that is too small for the largest tile
    /// is an error.
    pub memory_bytes: u64,
    /// Seed of every random choice.
    pub seed: u64,
    /// The device that computes the merge. Another device gives a result with other bytes.
    #[serde(default)]
    pub device: DeviceChoice,
}

impl Default for MergeSettings {
    fn default() -> Self {
        Self {
            epochs: 5,
            compress: true,
            refine: true,
            vouched: false,
            memory_bytes: 4 << 30,
            seed: 0,
            device: DeviceChoice::Auto,
        }
    }
}
