//! How long to wait and how much to have under way. The numbers are ours, chosen so that a link from
//! some kB/s to some 100 MB/s neither starves nor is flooded; tests hold the whole to its deadlines.

use std::time::Duration;

/// Chunks under way to one receiver whose fate is not known: 2 MiB at 64 KiB, well below what brokers
/// queue for a slow client (Mosquitto: 1000 messages).
pub(crate) const WINDOW: usize = 32;

/// A receiver speaks after this many new chunks, so that the window never runs dry on a clean link.
pub(crate) const WANT_EVERY: u32 = WINDOW as u32 / 2;

/// A chunk is lost if one sent this many chunks later has arrived: networks swap neighbours.
pub(crate) const REORDER: u64 = 3;

/// A sender that hears nothing offers its model again after this long, then ever more rarely.
pub(crate) const ANNOUNCE: Backoff = Backoff::new(Duration::from_secs(2), Duration::from_secs(30));

/// A receiver that hears nothing asks again at least this long after the last chunk.
pub(crate) const IDLE_MIN: Duration = Duration::from_secs(1);
/// And at most this long.
pub(crate) const IDLE_MAX: Duration = Duration::from_secs(60);
/// What a receiver takes for the time between two chunks before it has seen any: at 64 KiB, 100 kB/s.
pub(crate) const FIRST_GAP: Duration = Duration::from_millis(600);
/// So many usual gaps without a chunk mean that none is coming.
pub(crate) const IDLE_GAPS: u32 = 8;

/// A disk that was full is tried again after this long, then ever more rarely.
pub(crate) const STORE_AGAIN: Backoff = Backoff::new(Duration::from_secs(5), Duration::from_secs(60));

/// An unfinished model that got nothing for this long gives way where room is needed.
pub(crate) const STALLED: Duration = Duration::from_secs(300);
/// And is forgotten after this long in any case.
pub(crate) const ABANDONED: Duration = Duration::from_secs(3600);

/// A body that arrives whole but with a wrong hash is fetched anew this many times.
pub(crate) const FETCHES_MAX: u32 = 3;

/// A waiting time that doubles up to a limit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Backoff {
    first: Duration,
    next: Duration,
    max: Duration,
}

impl Backoff {
    pub(crate) const fn new(first: Duration, max: Duration) -> Self {
        Self { first, next: first, max }
    }

    /// How long to wait now; twice as long next time.
    pub(crate) fn delay(&mut self) -> Duration {
        let delay = self.next;
        self.next = (delay * 2).min(self.max);
        delay
    }

    pub(crate) fn reset(&mut self) {
        self.next = self.first;
    }
}
