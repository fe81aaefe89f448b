//! What a sender knows of one receiver.

use cosurf_wire::{DeviceId, Knowledge, RefusalReason, Want};

use crate::bits::BitSet;
use crate::pacing::{REORDER, WINDOW};

/// One receiver of one model.
#[derive(Debug)]
pub(crate) struct Peer {
    pub(crate) device: DeviceId,
    pub(crate) phase: Phase,
    /// Whether the sender waits for this receiver, or only serves it.
    pub(crate) is_required: bool,
    /// Missing there and not under way.
    wanted: BitSet,
    /// Under way; at most [`WINDOW`].
    in_flight: Vec<Sent>,
}

/// How far it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Phase {
    /// It has not said what it wants.
    Silent,
    /// It wants chunks.
    Fetching,
    /// It has all on its disk.
    Done,
    /// It will not have it.
    Refused(RefusalReason),
}

#[derive(Clone, Copy, Debug)]
struct Sent {
    index: u32,
    /// Counts all chunks sent to all receivers.
    order: u64,
}

impl Peer {
    pub(crate) fn new(device: DeviceId, chunks: u32, is_required: bool) -> Self {
        Self {
            device,
            phase: Phase::Silent,
            is_required,
            wanted: BitSet::full(chunks),
            in_flight: Vec::with_capacity(WINDOW),
        }
    }

    /// Whether nothing more is to be expected of it.
    pub(crate) fn is_settled(&self) -> bool {
        matches!(self.phase, Phase::Done | Phase::Refused(_))
    }

    /// Chunks that it has, as far as is known.
    pub(crate) fn chunks_there(&self, chunks: u32) -> u32 {
        match self.phase {
            Phase::Done => chunks,
            _ => chunks - self.wanted.len() - self.in_flight.len() as u32,
        }
    }

    /// The next chunk to send it, if it may have one more under way.
    pub(crate) fn next_chunk(&self) -> Option<u32> {
        let has_room = self.phase == Phase::Fetching && self.in_flight.len() < WINDOW;
        has_room.then(|| self.wanted.first()).flatten()
    }

    /// A chunk was published for all to hear.
    pub(crate) fn on_sent(&mut self, index: u32, order: u64) {
        if self.phase == Phase::Fetching && self.wanted.contains(index) && self.in_flight.len() < WINDOW {
            self.wanted.remove(index);
            self.in_flight.push(Sent { index, order });
        }
    }

    /// It says what it has and lacks. What it lacks of the chunks under way is lost if a later one has
    /// arrived, or if it says that none is coming any more.
    pub(crate) fn on_want(&mut self, chunks: u32, want: &Want) {
        self.phase = Phase::Fetching;
        let knowledge = |index| want.missing.of_chunk(index);
        let arrived = |sent: &&Sent| knowledge(sent.index) == Knowledge::Here;
        let newest = self.in_flight.iter().filter(arrived).map(|sent| sent.order).max();
        let is_lost = |sent: &Sent| want.idle || newest.is_some_and(|newest| sent.order + REORDER < newest);
        let wanted = &mut self.wanted;
        self.in_flight.retain(|sent| match knowledge(sent.index) {
            Knowledge::Here => false,
            Knowledge::Missing | Knowledge::Unsaid if is_lost(sent) => {
                wanted.insert(sent.index);
                false
            }
            Knowledge::Missing | Knowledge::Unsaid => true,
        });
        for index in 0..chunks {
            match knowledge(index) {
                Knowledge::Here => self.wanted.remove(index),
                Knowledge::Missing if !self.is_under_way(index) => self.wanted.insert(index),
                Knowledge::Missing | Knowledge::Unsaid => {}
            }
        }
    }

    /// It refuses. What it will take later it is offered later.
    pub(crate) fn on_refused(&mut self, reason: RefusalReason) {
        self.phase = if reason.is_passing() { Phase::Silent } else { Phase::Refused(reason) };
    }

    fn is_under_way(&self, index: u32) -> bool {
        self.in_flight.iter().any(|sent| sent.index == index)
    }
}
