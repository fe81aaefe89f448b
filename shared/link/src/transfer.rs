//! The transfer of one model to this receiver.

use std::ops::Range;
use std::sync::Arc;
use std::time::Duration;

use cosurf_scene::LocalFrame;
use cosurf_wire::{Chunk, Missing, ModelHeader, RefusalReason, Topic, Want};

use crate::bits::BitSet;
use crate::body::{Model, body_hash};
use crate::codec::{check_body, checked_part_to_model};
use crate::pacing::{
    Backoff, FETCHES_MAX, FIRST_GAP, IDLE_GAPS, IDLE_MAX, IDLE_MIN, NEVER_BEGUN, REPLACEABLE, ROOM_RETRY,
    STALLED, STORE_RETRY, WANT_AFTER, WANT_EVERY,
};

/// Memory that an upload may take before any chunk has arrived, bytes. A window of chunks of 32 KiB fits.
const FIRST_CLAIM_BYTES: u64 = 1 << 20;
/// So many times as many bytes as have arrived, an upload may take in addition.
const CLAIM_GROWTH: u64 = 16;

/// An unfinished model: the bytes that have arrived, the missing chunks, and the time of the next request.
#[derive(Debug)]
pub(crate) struct Transfer {
    pub(crate) header: ModelHeader,
    pub(crate) phase: TransferPhase,
    /// The sender's session that made the offer.
    pub(crate) session: u64,
    /// Topic of the `Want`s to the sender.
    pub(crate) want_topic: Topic,
    /// Time when the last new chunk arrived, or the header if no chunk has arrived.
    pub(crate) last_news: Duration,
    /// Time of the last chunk, new or not, or of the first connection after it.
    last_heard: Duration,
    /// Whether a connection has come after the last chunk.
    is_connected_since: bool,
    /// Time of the last `Want` that was marked `idle`. The sender needs time to react to it, so the next such
    /// `Want` must wait.
    last_idle: Duration,
    /// Time of the last `Want`.
    last_want: Duration,
    /// The start of the body: as much of it as the transfer may take.
    body: Arc<Vec<u8>>,
    received: BitSet,
    received_bytes: u64,
    new_since_want: u32,
    /// Average time between two new chunks.
    gap: Duration,
    want_backoff: Backoff,
    store_backoff: Backoff,
    fetches: u32,
}

/// The phase of a transfer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum TransferPhase {
    /// Chunks are missing. The next `Want` is due at `want_at`.
    Fetching { want_at: Duration },
    /// The body is complete and valid. The caller gets it for storing at time `at`.
    ToStore { at: Duration, is_retry: bool },
    /// The caller is storing the body.
    Storing,
}

/// The result of taking a chunk.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ChunkOutcome {
    /// The chunk was new.
    Taken,
    /// The chunk had already arrived, or there is no room for it yet.
    Known,
    /// The chunk contradicts the header. Or it completed a body with a wrong hash, and all chunks are fetched
    /// again.
    Bad,
    /// The chunk completed the body, but the body is invalid.
    BadBody(RefusalReason),
}

impl Transfer {
    /// Starts a transfer that takes `claim` bytes. The caller must have checked the header's sizes against the limits.
    pub(crate) fn new(
        now: Duration,
        header: ModelHeader,
        session: u64,
        claim: u64,
        want_topic: Topic,
    ) -> Self {
        Self {
            header,
            session,
            phase: TransferPhase::Fetching { want_at: now },
            want_topic,
            last_news: now,
            last_heard: now,
            is_connected_since: false,
            last_idle: now,
            last_want: now,
            body: Arc::new(vec![0; claim as usize]),
            received: BitSet::empty(header.chunks()),
            received_bytes: 0,
            new_since_want: 0,
            gap: FIRST_GAP,
            want_backoff: Backoff::new(FIRST_GAP, IDLE_MAX),
            store_backoff: STORE_RETRY,
            fetches: 1,
        }
    }

    pub(crate) fn body(&self) -> Arc<Vec<u8>> {
        Arc::clone(&self.body)
    }

    /// Bytes that an upload takes at first.
    pub(crate) fn first_claim(header: &ModelHeader) -> u64 {
        header.body_bytes.min(FIRST_CLAIM_BYTES)
    }

    /// Bytes that the transfer takes.
    pub(crate) fn claim(&self) -> u64 {
        self.body.len() as u64
    }

    /// Bytes that the transfer may take if there is room for them: the whole body soon, but not before a share of it has
    /// arrived.
    pub(crate) fn wanted_claim(&self) -> u64 {
        let grown = FIRST_CLAIM_BYTES.saturating_add(self.received_bytes.saturating_mul(CLAIM_GROWTH));
        self.header.body_bytes.min(grown).max(self.claim())
    }

    /// Lets the transfer take `claim` bytes.
    pub(crate) fn grow(&mut self, claim: u64) {
        // Always succeeds: the body is shared only once it is complete.
        if let Some(body) = Arc::get_mut(&mut self.body) {
            body.resize(claim as usize, 0);
        }
    }

    /// Bytes that have arrived.
    pub(crate) fn received_bytes(&self) -> u64 {
        self.received_bytes
    }

    /// Whether chunks are missing, and none of the missing ones has room.
    pub(crate) fn lacks_room(&self) -> bool {
        let missing = (0..self.header.chunks()).find(|index| !self.received.contains(*index));
        let end = missing.and_then(|index| self.header.chunk_range(index)).map_or(0, |range| range.end);
        matches!(self.phase, TransferPhase::Fetching { .. }) && end > self.claim()
    }

    /// Waits for room, without a request to the sender.
    pub(crate) fn wait_for_room(&mut self, now: Duration) {
        self.phase = TransferPhase::Fetching { want_at: now + ROOM_RETRY };
    }

    /// Whether chunks are missing.
    pub(crate) fn is_fetching(&self) -> bool {
        matches!(self.phase, TransferPhase::Fetching { .. })
    }

    /// Whether another model may take the room of this one: chunks are missing, and none has arrived for a while.
    pub(crate) fn is_stalled(&self, now: Duration) -> bool {
        let patience = if self.received_bytes == 0 { NEVER_BEGUN } else { STALLED };
        self.is_fetching() && now.saturating_sub(self.last_news) >= patience
    }

    /// Decodes the packs that have arrived into the body's own frame, which is returned. Returns `None` if no splats have
    /// arrived, or not their origin, if a pack is invalid, or if the
    /// body contradicts the header. The hash is not checked, because it covers the whole body; each pack has its own
    /// checksum.
    pub(crate) fn part(&self) -> Option<(LocalFrame, Model)> {
        let chunk_bytes = self.header.chunk_bytes as usize;
        let is_here = |range: Range<usize>| {
            let mut chunks = range.start / chunk_bytes..range.end.div_ceil(chunk_bytes);
            chunks.all(|index| self.received.contains(index as u32))
        };
        checked_part_to_model(&self.header, &self.body, is_here).ok().flatten()
    }

    /// Time at which the transfer next has something to do; `None` while the caller stores the body.
    pub(crate) fn due(&self) -> Option<Duration> {
        match self.phase {
            TransferPhase::Fetching { want_at } => Some(want_at),
            TransferPhase::ToStore { at, .. } => Some(at),
            TransferPhase::Storing => None,
        }
    }

    /// Whether another header takes the place of this one: if no chunk has arrived for a while, or if its sender makes the
    /// chunks smaller and has signed it. Without a signature, chunks may become smaller only while none has arrived: over a
    /// line that breaks before it has carried a large one, none ever would.
    pub(crate) fn may_be_replaced(&self, now: Duration, by: &ModelHeader, is_signed: bool) -> bool {
        let is_smaller = ModelHeader { chunk_bytes: by.chunk_bytes, ..self.header } == *by
            && by.chunk_bytes < self.header.chunk_bytes;
        let is_free = is_signed || self.received_bytes == 0;
        now.saturating_sub(self.last_news) >= REPLACEABLE || (is_free && is_smaller)
    }

    /// Continues with chunks of another size. What has arrived is kept. Returns false if the header is not that of the same
    /// model.
    pub(crate) fn continue_with(&mut self, now: Duration, header: ModelHeader, session: u64) -> bool {
        let old = self.header;
        if (ModelHeader { chunk_bytes: header.chunk_bytes, ..old }) != header {
            return false;
        }
        let chunk_bytes = u64::from(old.chunk_bytes);
        let before = std::mem::replace(&mut self.received, BitSet::empty(0));
        (self.header, self.session) = (header, session);
        self.count_received(|range| {
            let mut chunks = range.start / chunk_bytes..range.end.div_ceil(chunk_bytes);
            chunks.all(|chunk| before.contains(chunk as u32))
        });
        self.phase = TransferPhase::Fetching { want_at: now };
        true
    }

    /// Counts those chunks as received, and no others, of whose range of the body `is_here` tells that it has arrived.
    fn count_received(&mut self, is_here: impl Fn(&Range<u64>) -> bool) {
        (self.received, self.received_bytes) = (BitSet::empty(self.header.chunks()), 0);
        for index in 0..self.header.chunks() {
            if let Some(range) = self.header.chunk_range(index).filter(&is_here) {
                self.received.insert(index);
                self.received_bytes += range.end - range.start;
            }
        }
    }

    /// Notes a new connection. The chunks that a broker has kept for this receiver come now. If the receiver asked for them at
    /// once, they would come twice, so its wait begins anew. Only the first connection after a chunk has this effect: if every
    /// one had, and each broke within a second, the receiver would never ask for lost chunks. What has arrived is told at once,
    /// because at the next connection the sender decides whether its chunks are too large for the line.
    pub(crate) fn on_connected(&mut self, now: Duration) {
        if !self.is_connected_since {
            (self.last_heard, self.is_connected_since) = (now, true);
        }
        self.tell_what_is_new(now);
    }

    /// Schedules a `Want` for `now` if chunks have arrived since the last one.
    pub(crate) fn tell_what_is_new(&mut self, now: Duration) {
        if let TransferPhase::Fetching { want_at } = &mut self.phase
            && self.new_since_want > 0
        {
            *want_at = now;
        }
    }

    /// Schedules a `Want` for `now`, because the sender has repeated its offer.
    pub(crate) fn on_offered_again(&mut self, now: Duration) {
        if let TransferPhase::Fetching { want_at } = &mut self.phase {
            *want_at = now;
        }
    }

    pub(crate) fn on_chunk(&mut self, now: Duration, chunk: &Chunk<'_>) -> ChunkOutcome {
        let Some(range) = self.header.chunk_range(chunk.index) else {
            return ChunkOutcome::Bad;
        };
        let range = range.start as usize..range.end as usize;
        if chunk.payload.len() != range.len() {
            return ChunkOutcome::Bad;
        }
        let TransferPhase::Fetching { .. } = self.phase else {
            return ChunkOutcome::Known;
        };
        if self.received.contains(chunk.index) {
            self.on_duplicate(now);
            return ChunkOutcome::Known;
        }
        // Always succeeds: the body is shared only once it is complete.
        let Some(body) = Arc::get_mut(&mut self.body) else {
            return ChunkOutcome::Known;
        };
        let Some(place) = body.get_mut(range) else {
            return ChunkOutcome::Known;
        };
        place.copy_from_slice(chunk.payload);
        self.received.insert(chunk.index);
        self.received_bytes += chunk.payload.len() as u64;
        self.schedule_want(now);
        if self.received.len() < self.header.chunks() { ChunkOutcome::Taken } else { self.on_complete(now) }
    }

    /// Takes over what had arrived of the model before a restart, at most `bytes`: [`Self::place`] follows for each chunk, and
    /// then [`Self::resume`]. So much counts as arrived until then.
    pub(crate) fn expect(&mut self, bytes: u64) {
        self.received_bytes = bytes.min(self.header.body_bytes);
    }

    /// Puts bytes that had arrived before into the body, if there is room for them.
    pub(crate) fn place(&mut self, first: u64, bytes: &[u8]) {
        // Always succeeds: the body is shared only once it is complete.
        let Some(body) = Arc::get_mut(&mut self.body) else { return };
        let place = first as usize..first as usize + bytes.len();
        if let Some(place) = body.get_mut(place) {
            place.copy_from_slice(bytes);
        }
    }

    /// Counts the chunks as received that lie within these ranges of the body and have room.
    pub(crate) fn resume(&mut self, now: Duration, here: &[Range<u64>]) -> ChunkOutcome {
        let claim = self.claim();
        self.count_received(|range| {
            let after = here.partition_point(|other| other.start <= range.start);
            range.end <= claim && after.checked_sub(1).is_some_and(|last| range.end <= here[last].end)
        });
        self.phase = TransferPhase::Fetching { want_at: now };
        if self.received.len() < self.header.chunks() { ChunkOutcome::Taken } else { self.on_complete(now) }
    }

    /// Makes the `Want` that is due now.
    pub(crate) fn want(&mut self, now: Duration) -> Want {
        let missing = Missing::of(self.header.chunks(), |index| self.received.contains(index));
        let idle = now.saturating_sub(self.last_heard.max(self.last_idle)) >= self.idle_after();
        if idle {
            self.last_idle = now;
        }
        (self.new_since_want, self.last_want) = (0, now);
        self.phase = TransferPhase::Fetching { want_at: now + self.want_backoff.delay() };
        let ModelHeader { device, model, .. } = self.header;
        Want { device, model, session: self.session, idle, missing }
    }

    /// Schedules another attempt to store the body, because the caller could not store it.
    pub(crate) fn on_store_failed(&mut self, now: Duration) {
        self.phase = TransferPhase::ToStore { at: now + self.store_backoff.delay(), is_retry: true };
    }

    /// A chunk that arrives again is a sign that others are on their way behind it. Otherwise, what is sent twice after a line
    /// has stalled would make the receiver ask for what follows it, and so on to the end: on a line of 30 kB/s, one stall of two
    /// seconds had 2.7 times as many bytes sent. Strangers who repeat a chunk delay a request by [`IDLE_GAPS`] times that wait.
    fn on_duplicate(&mut self, now: Duration) {
        if now.saturating_sub(self.last_news) >= (self.idle_after() * IDLE_GAPS).min(IDLE_MAX) {
            return;
        }
        (self.last_heard, self.is_connected_since) = (now, false);
        let later = now + self.idle_after();
        if let TransferPhase::Fetching { want_at } = &mut self.phase
            && *want_at > now
        {
            *want_at = later.max(*want_at);
        }
    }

    /// Updates the average gap after a new chunk, and schedules the next `Want`.
    fn schedule_want(&mut self, now: Duration) {
        // Capping the gap limits the effect of an outage on the average.
        let gap = now.saturating_sub(self.last_news).min(self.gap * IDLE_GAPS);
        self.gap = (self.gap * 7 + gap) / 8;
        (self.last_news, self.last_heard, self.is_connected_since) = (now, now, false);
        self.new_since_want += 1;
        let idle_after = self.idle_after();
        self.want_backoff = Backoff::new(idle_after, IDLE_MAX);
        let is_due = self.new_since_want >= WANT_EVERY || now.saturating_sub(self.last_want) >= WANT_AFTER;
        let wait = if is_due { Duration::ZERO } else { idle_after };
        self.phase = TransferPhase::Fetching { want_at: now + wait };
    }

    /// If no new chunk arrives for this long, no more chunks are expected.
    fn idle_after(&self) -> Duration {
        (self.gap * IDLE_GAPS).clamp(IDLE_MIN, IDLE_MAX)
    }

    /// Checks the complete body against the header. If the hash is wrong, fetches all chunks again, at most
    /// [`FETCHES_MAX`] times in total.
    fn on_complete(&mut self, now: Duration) -> ChunkOutcome {
        if body_hash(&self.body) != self.header.blake3 {
            if self.fetches >= FETCHES_MAX {
                return ChunkOutcome::BadBody(RefusalReason::Garbled);
            }
            self.fetches += 1;
            self.received = BitSet::empty(self.header.chunks());
            self.received_bytes = 0;
            self.phase = TransferPhase::Fetching { want_at: now };
            return ChunkOutcome::Bad;
        }
        if check_body(&self.header, &self.body).is_err() {
            return ChunkOutcome::BadBody(RefusalReason::BadBody);
        }
        self.phase = TransferPhase::ToStore { at: now, is_retry: false };
        ChunkOutcome::Taken
    }
}
