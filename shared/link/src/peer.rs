//! A sender's state for one receiver.

use std::time::Duration;

use cosurf_wire::{ChunkStatus, DeviceId, RefusalReason, Want};

use crate::bits::BitSet;
use crate::pacing::{
    ASKED_AGAIN, CHUNKS_PER_CONNECTION, OFFER_KNOWN, REORDER, REPEATED_WANT, REPLACEABLE, RESEND_ALL,
    SAME_CONNECTION, WINDOW_BYTES_MAX, WINDOW_BYTES_MIN, WINDOW_FAST, WINDOW_FIRST, WINDOW_MAX, WINDOW_MIN,
    WINDOW_SLOW,
};

/// Resends that each chunk earns that a receiver has for the first time. On a line that loses half of its messages, a
/// chunk takes one.
const RESENDS_EARNED: u32 = 2;

/// The transfer of one model to one receiver.
#[derive(Debug)]
pub(crate) struct Peer {
    pub(crate) device: DeviceId,
    pub(crate) phase: PeerPhase,
    /// Whether the upload is finished only when this receiver has the model.
    pub(crate) is_required: bool,
    /// Chunks that the receiver lacks and that are not in flight.
    wanted: BitSet,
    /// Chunks that were sent and are not acknowledged, at most `window`.
    in_flight: Vec<SentChunk>,
    /// Limit on them, which follows the line.
    window: usize,
    window_min: usize,
    window_max: usize,
    /// When all that was in flight may have been lost, if that was after the last `Want`. The chunks that were in flight before
    /// are lost, unless the next `Want` lists them.
    cut_at: Option<Duration>,
    /// Chunks that were sent to this receiver at least once, without those that the transport has lost since.
    sent: BitSet,
    /// Chunks that the transport has lost at least once. The broker may have got them all the same.
    lost: BitSet,
    /// Number of chunks that were sent to it, chunks sent again included.
    sends: u64,
    /// That number, and the number of chunks that the receiver was known to have, when it was last connected.
    before: (u64, u32),
    /// When it was last connected.
    connected_at: Option<Duration>,
    /// Number of the last connections, without a better one between them, over which hardly a chunk got through.
    poor: u32,
    /// The most chunks that the receiver is known to have had at once.
    chunks_had: u32,
    /// The number of chunks that the receiver had by the last `Want` that was not ignored, at least.
    chunks_known: u32,
    /// When the receiver may send the next request that shows no new chunk.
    repeat_at: Duration,
    /// Chunks that may be sent again to this receiver, and the time of that number.
    resends: (u32, Duration),
    resends_max: u32,
    /// When the receiver was last known to have got a chunk.
    gained_at: Duration,
    /// When the receiver last asked for chunks.
    asked_at: Option<Duration>,
    /// When the receiver is next believed that it has lost the model which it had stored.
    may_lose_at: Duration,
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
    at: Duration,
    /// Whether it was sent before. If it arrives, nobody knows which copy it was (Karn and Partridge 1987).
    is_again: bool,
    /// Sequence number among all chunks of the model sent to any receiver.
    order: u64,
}

impl Peer {
    /// A receiver of a body of `chunks` chunks of `chunk_bytes` bytes.
    pub(crate) fn new(device: DeviceId, chunks: u32, chunk_bytes: u32, is_required: bool) -> Self {
        let resends_max = chunks.max(WINDOW_FIRST as u32);
        let chunks_of = |bytes: usize| bytes / chunk_bytes.max(1) as usize;
        Self {
            device,
            phase: PeerPhase::Silent,
            is_required,
            wanted: BitSet::full(chunks),
            in_flight: Vec::new(),
            window: WINDOW_FIRST,
            window_min: chunks_of(WINDOW_BYTES_MIN).clamp(WINDOW_MIN, WINDOW_FIRST),
            window_max: chunks_of(WINDOW_BYTES_MAX).clamp(WINDOW_FIRST, WINDOW_MAX),
            cut_at: None,
            sent: BitSet::empty(chunks),
            lost: BitSet::empty(chunks),
            sends: 0,
            before: (0, 0),
            connected_at: None,
            poor: 0,
            chunks_had: 0,
            chunks_known: 0,
            repeat_at: Duration::ZERO,
            resends: (resends_max, Duration::ZERO),
            resends_max,
            gained_at: Duration::ZERO,
            asked_at: None,
            may_lose_at: Duration::ZERO,
        }
    }

    /// Begins again with a receiver that lacks all of the model which it had stored. It is not required any more: the upload
    /// stays finished. Returns false if the receiver is not believed, because it has lost the model just before.
    pub(crate) fn on_lost(&mut self, now: Duration, chunks: u32, want: &Want) -> bool {
        let lacks_all = (0..chunks).all(|index| want.missing.status_of(index) != ChunkStatus::Received);
        if self.phase != PeerPhase::Done || !lacks_all || now < self.may_lose_at {
            return false;
        }
        self.begin_again(chunks);
        (self.is_required, self.may_lose_at) = (false, now + ASKED_AGAIN);
        self.take_want(now, chunks, want);
        true
    }

    /// Forgets that the receiver has any chunk. What it gets now was sent before, so it counts as sent again.
    pub(crate) fn begin_again(&mut self, chunks: u32) {
        (self.phase, self.wanted, self.chunks_known) = (PeerPhase::Silent, BitSet::full(chunks), 0);
        self.in_flight.clear();
    }

    /// The same transfer with a body of `chunks` chunks of `chunk_bytes` bytes, which were of `before_bytes`.
    pub(crate) fn with_chunks(&self, chunks: u32, chunk_bytes: u32, before_bytes: u32) -> Self {
        let known = u64::from(self.chunks_known) * u64::from(before_bytes) / u64::from(chunk_bytes.max(1));
        let chunks_known = u32::try_from(known).unwrap_or(chunks).min(chunks);
        Self {
            chunks_known,
            gained_at: self.gained_at,
            ..Self::new(self.device, chunks, chunk_bytes, self.is_required)
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

    /// Index of the next chunk to send, if the receiver wants one, the window has room for it and, for a chunk that was
    /// sent before, the receiver may have chunks sent again.
    pub(crate) fn next_chunk(&self, now: Duration) -> Option<u32> {
        if !self.has_room() {
            return None;
        }
        if self.resends_at(now) > 0 { self.wanted.first() } else { self.wanted.first_outside(&self.sent) }
    }

    /// When the receiver may have a chunk sent again; `None` if it waits for none.
    pub(crate) fn next_resend(&self) -> Option<Duration> {
        let waits = self.has_room() && self.resends.0 == 0 && self.wanted.len() > 0;
        waits.then(|| self.resends.1 + RESEND_ALL / self.resends_max)
    }

    fn has_room(&self) -> bool {
        self.phase == PeerPhase::Fetching && self.in_flight.len() < self.window
    }

    /// Number of chunks that may be sent again.
    fn resends_at(&self, now: Duration) -> u32 {
        let (left, at) = self.resends;
        let since = now.saturating_sub(at).as_secs_f64() / RESEND_ALL.as_secs_f64();
        let earned = (since * f64::from(self.resends_max)) as u32;
        left.saturating_add(earned).min(self.resends_max)
    }

    /// Counts the resends that the time has earned.
    fn earn_resends(&mut self, now: Duration) {
        let left = self.resends_at(now);
        if left != self.resends.0 || left == self.resends_max {
            self.resends = (left, now);
        }
    }

    /// Records that chunk `index` was published, for this receiver (`is_due`) or for others that share the topic. What was
    /// published for others reaches this one too, even if its window is full or it has not asked yet; else it would be sent
    /// again. Does nothing if this receiver does not want the chunk, or has very many in flight.
    pub(crate) fn on_sent(&mut self, now: Duration, index: u32, order: u64, is_due: bool) {
        if !self.is_closed() && self.in_flight.len() < self.window_max && self.wanted.contains(index) {
            if is_due && self.sent.contains(index) {
                self.earn_resends(now);
                self.resends.0 = self.resends.0.saturating_sub(1);
            }
            let is_again = self.sent.contains(index) || self.lost.contains(index);
            self.sent.insert(index);
            self.sends += 1;
            self.wanted.remove(index);
            self.in_flight.push(SentChunk { index, at: now, is_again, order });
        }
    }

    /// Updates the state from a `Want`. A chunk in flight that the receiver is not known to have counts as
    /// lost in two cases: the receiver is idle, or a chunk sent more than [`REORDER`] places later has
    /// arrived. Returns false if the `Want` is ignored: it shows no new chunk, and the last such one was just before; or it
    /// shows fewer chunks than an earlier one. Over a line that breaks, a broker repeats what was not acknowledged, also
    /// after newer messages. A receiver that has lost chunks will say so again once it is idle.
    pub(crate) fn on_want(&mut self, now: Duration, chunks: u32, want: &Want) -> bool {
        let has = (0..chunks).filter(|index| want.missing.status_of(*index) == ChunkStatus::Received).count();
        if (has as u32) < self.chunks_known && !want.idle {
            return false;
        }
        self.chunks_known = has as u32;
        let new = (has as u32).saturating_sub(self.chunks_had);
        if new == 0 {
            if now < self.repeat_at {
                return false;
            }
            self.repeat_at = now + REPEATED_WANT;
        } else {
            self.gained_at = now;
        }
        self.chunks_had += new;
        self.earn_resends(now);
        self.resends.0 = self.resends.0.saturating_add(new * RESENDS_EARNED).min(self.resends_max);
        self.take_want(now, chunks, want);
        true
    }

    /// Notes that sender and receiver are connected again. Returns whether chunks should be smaller: hardly one has got
    /// through twice in a row. Once a chunk has arrived, a receiver takes smaller ones only if their sender signs, or if no
    /// other has arrived for [`REPLACEABLE`].
    pub(crate) fn on_connected(&mut self, now: Duration, chunks: u32, signs: bool) -> bool {
        // A broker may repeat what it was told of a connection.
        let last = self.connected_at.replace(now);
        if last.is_some_and(|last| now < last + SAME_CONNECTION) {
            return false;
        }
        let received = self.chunks_received(chunks);
        let (sends_before, received_before) = std::mem::replace(&mut self.before, (self.sends, received));
        let few =
            received < received_before + CHUNKS_PER_CONNECTION && chunks - received > CHUNKS_PER_CONNECTION;
        // What the last chunks of a connection have reached is known only in the next one, so one is not enough. A broker
        // may hold chunks that were sent long ago.
        let is_trying = self.sends > sends_before || !self.in_flight.is_empty();
        self.poor = if few && is_trying { self.poor + 1 } else { 0 };
        let is_taken = signs || received == 0 || now >= self.gained_at + REPLACEABLE;
        self.poor >= 2 && is_taken
    }

    /// Notes that all that was on its way may have been lost, the offer too. The receiver must ask again before it gets more
    /// chunks: it may be another one, which would drop them. What was in flight counts as lost then, unless it has arrived.
    pub(crate) fn on_cut(&mut self, now: Duration) {
        self.cut_at = Some(now);
        if self.phase == PeerPhase::Fetching {
            (self.phase, self.asked_at) = (PeerPhase::Silent, None);
        }
    }

    /// Notes that a chunk was probably lost before it reached the broker. Returns false if it is not in flight.
    pub(crate) fn on_lost_chunk(&mut self, index: u32) -> bool {
        let before = self.in_flight.len();
        self.in_flight.retain(|sent| sent.index != index);
        let is_in_flight = self.in_flight.len() < before;
        if is_in_flight {
            self.sent.remove(index);
            self.lost.insert(index);
            self.wanted.insert(index);
        }
        is_in_flight
    }

    /// The chunks in flight that have arrived, as far as they were sent only once.
    fn arrived(&self, want: &Want) -> impl Iterator<Item = &SentChunk> {
        let has_arrived =
            |sent: &&SentChunk| !sent.is_again && want.missing.status_of(sent.index) == ChunkStatus::Received;
        self.in_flight.iter().filter(has_arrived)
    }

    /// Learns from a `Want` how many chunks the line takes.
    fn learn(&mut self, now: Duration, want: &Want) {
        let Some(sent) = self.arrived(want).map(|sent| sent.at).max() else { return };
        let waited = now.saturating_sub(sent);
        if waited < WINDOW_FAST && self.in_flight.len() >= self.window / 2 {
            self.window = (2 * self.window).min(self.window_max);
        } else if waited > WINDOW_SLOW {
            self.window = (self.window / 2).max(self.window_min);
        }
    }

    /// Whether the receiver is fetching the model, and has asked for chunks just before.
    pub(crate) fn knows_offer(&self, now: Duration) -> bool {
        self.phase == PeerPhase::Fetching && self.asked_at.is_some_and(|at| now < at + OFFER_KNOWN)
    }

    fn take_want(&mut self, now: Duration, chunks: u32, want: &Want) {
        (self.phase, self.asked_at) = (PeerPhase::Fetching, Some(now));
        self.learn(now, want);
        let cut_at = self.cut_at.take();
        let status_of = |index| want.missing.status_of(index);
        let newest = self.arrived(want).map(|sent| sent.order).max();
        let is_lost = |sent: &SentChunk| {
            want.idle
                || cut_at.is_some_and(|at| sent.at < at)
                || newest.is_some_and(|newest| sent.order + REORDER < newest)
        };
        let wanted = &mut self.wanted;
        self.in_flight.retain(|sent| match status_of(sent.index) {
            ChunkStatus::Received => false,
            ChunkStatus::Missing | ChunkStatus::Unknown if is_lost(sent) => {
                wanted.insert(sent.index);
                false
            }
            ChunkStatus::Missing | ChunkStatus::Unknown => true,
        });
        let mut in_flight = BitSet::empty(chunks);
        self.in_flight.iter().for_each(|sent| in_flight.insert(sent.index));
        for index in 0..chunks {
            match status_of(index) {
                ChunkStatus::Received => self.wanted.remove(index),
                ChunkStatus::Missing if !in_flight.contains(index) => self.wanted.insert(index),
                ChunkStatus::Missing | ChunkStatus::Unknown => {}
            }
        }
    }

    /// The receiver refuses the model. If the reason is temporary, the model is offered again later.
    pub(crate) fn on_refused(&mut self, reason: RefusalReason) {
        self.phase = if reason.is_temporary() { PeerPhase::Silent } else { PeerPhase::Refused(reason) };
    }
}
