//! A sender's state for one receiver.

use cosurf_wire::{ChunkStatus, DeviceId, RefusalReason, Want};

use crate::bits::BitSet;
use crate::pacing::{REORDER, WINDOW};

/// The transfer of one model to one receiver.
#[derive(Debug)]
pub(crate) struct Peer {
    pub(crate) device: DeviceId,
    pub(crate) phase: PeerPhase,
    /// Whether the upload is finished only when this receiver has the model.
    pub(crate) is_required: bool,
    /// Chunks that the receiver lacks and that are not in flight.
    wanted: BitSet,
    /// Chunks that were sent and are not acknowledged, at most [`WINDOW`].
    in_flight: Vec<SentChunk>,
}

/// How far the transfer to a receiver has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum PeerPhase {
    /// The receiver has not sent a `Want` yet, or its last refusal was only temporary.
    Silent,
    /// The receiver has sent a `Want`, and is fetching chunks.
    Fetching,
    /// The receiver has stored the model.
    Done,
    /// The receiver has refused the model for good.
    Refused(RefusalReason),
}

#[derive(Clone, Copy, Debug)]
struct SentChunk {
    index: u32,
    /// Sequence number among all chunks of the model sent to any receiver.
    order: u64,
}

impl Peer {
    pub(crate) fn new(device: DeviceId, chunks: u32, is_required: bool) -> Self {
        Self {
            device,
            phase: PeerPhase::Silent,
            is_required,
            wanted: BitSet::full(chunks),
            in_flight: Vec::with_capacity(WINDOW),
        }
    }

    /// Whether the receiver has stored the model, or refused it for good.
    pub(crate) fn is_closed(&self) -> bool {
        matches!(self.phase, PeerPhase::Done | PeerPhase::Refused(_))
    }

    /// Number of chunks that the receiver is known to have.
    pub(crate) fn chunks_received(&self, chunks: u32) -> u32 {
        match self.phase {
            PeerPhase::Done => chunks,
            _ => chunks - self.wanted.len() - self.in_flight.len() as u32,
        }
    }

    /// Index of the next chunk to send, if the receiver wants one and the window has room for it.
    pub(crate) fn next_chunk(&self) -> Option<u32> {
        let has_room = self.phase == PeerPhase::Fetching && self.in_flight.len() < WINDOW;
        has_room.then(|| self.wanted.first()).flatten()
    }

    /// Records that chunk `index` was published, for this receiver or for another one: all receivers get it.
    /// Does nothing if this receiver is not fetching, does not want the chunk, or has a full window.
    pub(crate) fn on_sent(&mut self, index: u32, order: u64) {
        if self.phase == PeerPhase::Fetching && self.wanted.contains(index) && self.in_flight.len() < WINDOW {
            self.wanted.remove(index);
            self.in_flight.push(SentChunk { index, order });
        }
    }

    /// Updates the state from a `Want`. A chunk in flight that the receiver is not known to have counts as
    /// lost in two cases: the receiver is idle, or a chunk sent more than [`REORDER`] places later has
    /// arrived.
    pub(crate) fn on_want(&mut self, chunks: u32, want: &Want) {
        self.phase = PeerPhase::Fetching;
        let status_of = |index| want.missing.status_of(index);
        let has_arrived = |sent: &&SentChunk| status_of(sent.index) == ChunkStatus::Received;
        let newest = self.in_flight.iter().filter(has_arrived).map(|sent| sent.order).max();
        let is_lost =
            |sent: &SentChunk| want.idle || newest.is_some_and(|newest| sent.order + REORDER < newest);
        let wanted = &mut self.wanted;
        self.in_flight.retain(|sent| match status_of(sent.index) {
            ChunkStatus::Received => false,
            ChunkStatus::Missing | ChunkStatus::Unknown if is_lost(sent) => {
                wanted.insert(sent.index);
                false
            }
            ChunkStatus::Missing | ChunkStatus::Unknown => true,
        });
        for index in 0..chunks {
            match status_of(index) {
                ChunkStatus::Received => self.wanted.remove(index),
                ChunkStatus::Missing if !self.is_in_flight(index) => self.wanted.insert(index),
                ChunkStatus::Missing | ChunkStatus::Unknown => {}
            }
        }
    }

    /// The receiver refuses the model. If the reason is temporary, the model is offered again later.
    pub(crate) fn on_refused(&mut self, reason: RefusalReason) {
        self.phase = if reason.is_temporary() { PeerPhase::Silent } else { PeerPhase::Refused(reason) };
    }

    fn is_in_flight(&self, index: u32) -> bool {
        self.in_flight.iter().any(|sent| sent.index == index)
    }
}
