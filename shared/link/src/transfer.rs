//! The download of one model.

use std::ops::Range;
use std::sync::Arc;
use std::time::Duration;

use cosurf_wire::{Chunk, Missing, ModelHeader, RefusalReason, Topic, Want};

use crate::bits::BitSet;
use crate::body::{Model, body_hash};
use crate::codec::{check_body, checked_part_to_model};
use crate::pacing::{
    Backoff, FETCHES_MAX, FIRST_GAP, IDLE_GAPS, IDLE_MAX, IDLE_MIN, STORE_RETRY, WANT_EVERY,
};

/// An unfinished model: the bytes received, the missing chunks, and the time of the next request.
#[derive(Debug)]
pub(crate) struct Transfer {
    pub(crate) header: ModelHeader,
    pub(crate) phase: TransferPhase,
    /// Topic of the replies to the sender.
    pub(crate) want_topic: Topic,
    /// Time of the last new chunk, or of the header if none has arrived.
    pub(crate) last_news: Duration,
    /// Time of the last `Want` with `idle`. The sender needs time to react to it.
    last_idle: Duration,
    body: Arc<Vec<u8>>,
    received: BitSet,
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
    /// The body is complete and valid. It is handed out for storing at `at`.
    ToStore { at: Duration, is_retry: bool },
    /// The caller is storing the body.
    Storing,
}

/// The result of taking a chunk.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ChunkOutcome {
    /// The chunk was new.
    Taken,
    /// The chunk had already arrived.
    Known,
    /// The chunk contradicts the header.
    Bad,
    /// The chunk completed the body, but the body is invalid.
    BadBody(RefusalReason),
}

impl Transfer {
    /// Starts a transfer. The caller has checked the header's sizes against the limits.
    pub(crate) fn new(now: Duration, header: ModelHeader, want_topic: Topic) -> Self {
        Self {
            header,
            phase: TransferPhase::Fetching { want_at: now },
            want_topic,
            last_news: now,
            last_idle: now,
            body: Arc::new(vec![0; header.body_bytes as usize]),
            received: BitSet::empty(header.chunks()),
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

    /// Decodes the packs that have arrived; `None` without any splats. The checksums of the packs are checked.
    /// The hash cannot be: it covers the whole body.
    pub(crate) fn part(&self) -> Option<Model> {
        let chunk_bytes = self.header.chunk_bytes as usize;
        let is_here = |range: Range<usize>| {
            let mut chunks = range.start / chunk_bytes..range.end.div_ceil(chunk_bytes);
            chunks.all(|index| self.received.contains(index as u32))
        };
        checked_part_to_model(&self.header, &self.body, is_here).ok().flatten()
    }

    /// When the transfer next has something to do.
    pub(crate) fn due(&self) -> Option<Duration> {
        match self.phase {
            TransferPhase::Fetching { want_at } => Some(want_at),
            TransferPhase::ToStore { at, .. } => Some(at),
            TransferPhase::Storing => None,
        }
    }

    /// The sender repeats its offer, so it needs a `Want` now.
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
            return ChunkOutcome::Known;
        }
        // Always succeeds: the body is shared only once it is complete.
        let Some(body) = Arc::get_mut(&mut self.body) else {
            return ChunkOutcome::Known;
        };
        body[range].copy_from_slice(chunk.payload);
        self.received.insert(chunk.index);
        self.schedule_want(now);
        if self.received.len() < self.header.chunks() { ChunkOutcome::Taken } else { self.on_complete(now) }
    }

    /// Makes the `Want` that is due now.
    pub(crate) fn want(&mut self, now: Duration) -> Want {
        let missing = Missing::of(self.header.chunks(), |index| self.received.contains(index));
        let idle = now.saturating_sub(self.last_news.max(self.last_idle)) >= self.idle_after();
        if idle {
            self.last_idle = now;
        }
        self.new_since_want = 0;
        self.phase = TransferPhase::Fetching { want_at: now + self.want_backoff.delay() };
        Want { device: self.header.device, model: self.header.model, idle, missing }
    }

    /// The caller could not store the body: retry later.
    pub(crate) fn on_store_failed(&mut self, now: Duration) {
        self.phase = TransferPhase::ToStore { at: now + self.store_backoff.delay(), is_retry: true };
    }

    /// Updates the average gap after a new chunk, and schedules the next `Want`.
    fn schedule_want(&mut self, now: Duration) {
        // Limits the effect of an outage on the average.
        let gap = now.saturating_sub(self.last_news).min(self.gap * IDLE_GAPS);
        self.gap = (self.gap * 7 + gap) / 8;
        self.last_news = now;
        self.new_since_want += 1;
        let idle_after = self.idle_after();
        self.want_backoff = Backoff::new(idle_after, IDLE_MAX);
        let wait = if self.new_since_want >= WANT_EVERY { Duration::ZERO } else { idle_after };
        self.phase = TransferPhase::Fetching { want_at: now + wait };
    }

    /// After this long without a new chunk, no more is expected.
    fn idle_after(&self) -> Duration {
        (self.gap * IDLE_GAPS).clamp(IDLE_MIN, IDLE_MAX)
    }

    /// All chunks have arrived: checks the body against the header.
    fn on_complete(&mut self, now: Duration) -> ChunkOutcome {
        if body_hash(&self.body) != self.header.blake3 {
            if self.fetches >= FETCHES_MAX {
                return ChunkOutcome::BadBody(RefusalReason::BadBody);
            }
            self.fetches += 1;
            self.received = BitSet::empty(self.header.chunks());
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
