//! Timeouts and window sizes. They are chosen so that links from a few kB/s to some 100 MB/s are neither idle
//! nor flooded; the fleet tests check the resulting deadlines.

use std::time::Duration;

/// Maximum number of unacknowledged chunks to one receiver: 2 MiB at 64 KiB, well below what brokers queue
/// for a slow client (Mosquitto: 1000 messages).
pub(crate) const WINDOW: usize = 32;

/// A receiver sends a `Want` after this many new chunks, so that the sender's window never fills up on a
/// good link.
pub(crate) const WANT_EVERY: u32 = WINDOW as u32 / 2;

/// A chunk counts as lost once a chunk sent this many places later has arrived. The margin tolerates
/// reordering.
pub(crate) const REORDER: u64 = 3;

/// Delays before a sender without a reply offers its model again.
pub(crate) const ANNOUNCE: Backoff = Backoff::new(Duration::from_secs(2), Duration::from_secs(30));

/// Minimum time after the last chunk before a receiver sends another `Want`.
pub(crate) const IDLE_MIN: Duration = Duration::from_secs(1);
/// Maximum time after the last chunk before a receiver sends another `Want`.
pub(crate) const IDLE_MAX: Duration = Duration::from_secs(60);
/// A receiver's first estimate of the time between two chunks: that of 64 KiB at 100 kB/s.
pub(crate) const FIRST_GAP: Duration = Duration::from_millis(600);
/// After this many average gaps without a chunk, a receiver assumes that no more is coming.
pub(crate) const IDLE_GAPS: u32 = 8;

/// Delays before storing a model is retried, for example on a full disk.
pub(crate) const STORE_RETRY: Backoff = Backoff::new(Duration::from_secs(5), Duration::from_secs(60));

/// An unfinished model without a new chunk for this long is dropped if its room is needed.
pub(crate) const STALLED: Duration = Duration::from_secs(300);
/// An unfinished model without a new chunk for this long is dropped in any case.
pub(crate) const ABANDONED: Duration = Duration::from_secs(3600);

/// Number of times that a body is fetched before a wrong hash makes the receiver refuse it.
pub(crate) const FETCHES_MAX: u32 = 3;

/// Exponential backoff: a delay that doubles up to a limit.
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

    /// Returns the current delay and doubles the next one.
    pub(crate) fn delay(&mut self) -> Duration {
        let delay = self.next;
        self.next = (delay * 2).min(self.max);
        delay
    }

    pub(crate) fn reset(&mut self) {
        self.next = self.first;
    }
}
