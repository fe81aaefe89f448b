//! The receiving half of the conversation.

use cosurf_wire::RefusalReason;

use crate::ModelKey;

/// What a receiver takes at most.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct InboxLimits {
    /// Bytes of one body.
    pub body_bytes_max: u64,
    /// Bytes of all unfinished bodies together; the memory the inbox may take.
    pub total_bytes_max: u64,
    /// Unfinished models at once.
    pub models_max: usize,
    /// Finished models remembered, so that a repeated offer is answered without the body.
    pub stored_max: usize,
}

/// Collects models from headers and chunks, in any order, doubled, damaged.
#[derive(Debug)]
pub struct Inbox {}

impl Inbox {
    /// The body that [`crate::NodeEvent::Store`] handed out is on the disk, synced and renamed: say so to its sender.
    pub fn stored(&mut self, _key: ModelKey) {
        unimplemented!("lands soon")
    }

    /// It is not, and may be tried again (disk full): it is asked for again after a while.
    pub fn store_failed(&mut self, _key: ModelKey) {
        unimplemented!("lands soon")
    }

    /// It is not wanted.
    pub fn refuse(&mut self, _key: ModelKey, _reason: RefusalReason) {
        unimplemented!("lands soon")
    }
}
