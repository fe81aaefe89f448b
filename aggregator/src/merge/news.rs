//! What the threads report that distil tiles, or wait for workers.

use cosurf_scene::Splats;

use super::error::MergeError;
use super::results::TileRecord;

/// What a thread that distils tiles, or waits for workers, reports.
pub(super) enum Report {
    /// PSNR of a step, dB.
    Step(f64),
    /// The tile with this index is done.
    Done(usize, Result<Learnt, MergeError>),
    /// Nothing new from the workers.
    Waiting,
}

/// A distilled tile.
pub(super) struct Learnt {
    pub(super) record: TileRecord,
    pub(super) splats: Splats,
    /// Whether the result was in the store.
    pub(super) was_found: bool,
}
