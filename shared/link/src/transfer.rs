//! One model on its way in.

use std::ops::Range;
use std::sync::Arc;
use std::time::Duration;

use cosurf_wire::{Chunk, Missing, ModelHeader, RefusalReason, Topic, Want};

use crate::bits::BitSet;
use crate::body::{Model, body_hash};
use crate::codec::{announced_part, check_body};
use crate::pacing::{
    Backoff, FETCHES_MAX, FIRST_GAP, IDLE_GAPS, IDLE_MAX, IDLE_MIN, STORE_AGAIN, WANT_EVERY,
};

/// An unfinished model: bytes so far, what is missing, when to ask.
#[derive(Debug)]
pub(crate) struct Transfer {
    pub(crate) header: ModelHeader,
    pub(crate) phase: Phase,
    /// Where the answers to its sender go.
    pub(crate) want_topic: Topic,
    /// When the last new chunk came; at first when the header did.
    pub(crate) last_news: Duration,
    /// When its sender was last told that nothing comes; it needs time to answer.
    last_idle: Duration,
    body: Arc<Vec<u8>>,
    here: BitSet,
    news_since_want: u32,
    /// Usual time between two new chunks.
    gap: Duration,
    want_backoff: Backoff,
    store_backoff: Backoff,
    fetches: u32,
}

/// Where a transfer stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Phase {
    /// Chunks are missing; they are asked for at `want_at`.
    Fetching { want_at: Duration },
    /// All is here and right; it goes to the owner at `at`.
    ToStore { at: Duration, is_retry: bool },
    /// The owner writes it.
    Storing,
}

/// What a chunk did.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ChunkOutcome {
    /// It was new.
    Taken,
    /// It was here already.
    Known,
    /// It is not what the header announces.
    Bad,
    /// With it all chunks are here, but they are not a body that can be used.
    Spoilt(RefusalReason),
}

impl Transfer {
    /// Begins; the header's sizes have been held against the limits.
    pub(crate) fn new(now: Duration, header: ModelHeader, want_topic: Topic) -> Self {
        Self {
            header,
            phase: Phase::Fetching { want_at: now },
            want_topic,
            last_news: now,
            last_idle: now,
            body: Arc::new(vec![0; header.body_bytes as usize]),
            here: BitSet::empty(header.chunks()),
            news_since_want: 0,
            gap: FIRST_GAP,
            want_backoff: Backoff::new(FIRST_GAP, IDLE_MAX),
            store_backoff: STORE_AGAIN,
            fetches: 1,
        }
    }

    pub(crate) fn body(&self) -> Arc<Vec<u8>> {
        Arc::clone(&self.body)
    }

    /// What has arrived, as far as that is a model already. Its hash cannot be checked before all is there; the
    /// checksums of its packs can.
    pub(crate) fn part(&self) -> Option<Model> {
        let chunk_bytes = self.header.chunk_bytes as usize;
        let is_here = |range: Range<usize>| {
            let mut chunks = range.start / chunk_bytes..range.end.div_ceil(chunk_bytes);
            chunks.all(|index| self.here.contains(index as u32))
        };
        announced_part(&self.header, &self.body, is_here).ok().flatten()
    }

    /// When it next wants to be looked at.
    pub(crate) fn due(&self) -> Option<Duration> {
        match self.phase {
            Phase::Fetching { want_at } => Some(want_at),
            Phase::ToStore { at, .. } => Some(at),
            Phase::Storing => None,
        }
    }

    /// Its sender offers it again: it wants to know where we are.
    pub(crate) fn on_offered_again(&mut self, now: Duration) {
        if let Phase::Fetching { want_at } = &mut self.phase {
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
        let Phase::Fetching { .. } = self.phase else {
            return ChunkOutcome::Known;
        };
        if self.here.contains(chunk.index) {
            return ChunkOutcome::Known;
        }
        // While chunks are missing nobody else holds the body.
        let Some(body) = Arc::get_mut(&mut self.body) else {
            return ChunkOutcome::Known;
        };
        body[range].copy_from_slice(chunk.payload);
        self.here.insert(chunk.index);
        self.note_news(now);
        if self.here.len() < self.header.chunks() { ChunkOutcome::Taken } else { self.on_complete(now) }
    }

    /// What to ask for now.
    pub(crate) fn want(&mut self, now: Duration) -> Want {
        let missing = Missing::of(self.header.chunks(), |index| self.here.contains(index));
        let idle = now.saturating_sub(self.last_news.max(self.last_idle)) >= self.idle_after();
        if idle {
            self.last_idle = now;
        }
        self.news_since_want = 0;
        self.phase = Phase::Fetching { want_at: now + self.want_backoff.delay() };
        Want { device: self.header.device, model: self.header.model, idle, missing }
    }

    /// The owner could not write it: later.
    pub(crate) fn on_store_failed(&mut self, now: Duration) {
        self.phase = Phase::ToStore { at: now + self.store_backoff.delay(), is_retry: true };
    }

    fn note_news(&mut self, now: Duration) {
        // An outage is not a usual gap.
        let gap = now.saturating_sub(self.last_news).min(self.gap * IDLE_GAPS);
        self.gap = (self.gap * 7 + gap) / 8;
        self.last_news = now;
        self.news_since_want += 1;
        let idle_after = self.idle_after();
        self.want_backoff = Backoff::new(idle_after, IDLE_MAX);
        let wait = if self.news_since_want >= WANT_EVERY { Duration::ZERO } else { idle_after };
        self.phase = Phase::Fetching { want_at: now + wait };
    }

    /// So long without news means that none is coming.
    fn idle_after(&self) -> Duration {
        (self.gap * IDLE_GAPS).clamp(IDLE_MIN, IDLE_MAX)
    }

    /// All chunks are here: do they make the body that was announced?
    fn on_complete(&mut self, now: Duration) -> ChunkOutcome {
        if body_hash(&self.body) != self.header.blake3 {
            if self.fetches >= FETCHES_MAX {
                return ChunkOutcome::Spoilt(RefusalReason::BadBody);
            }
            self.fetches += 1;
            self.here = BitSet::empty(self.header.chunks());
            self.phase = Phase::Fetching { want_at: now };
            return ChunkOutcome::Bad;
        }
        if check_body(&self.header, &self.body).is_err() {
            return ChunkOutcome::Spoilt(RefusalReason::BadBody);
        }
        self.phase = Phase::ToStore { at: now, is_retry: false };
        ChunkOutcome::Taken
    }
}
