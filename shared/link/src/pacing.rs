//! Timeouts and window sizes. They are chosen so that links from a few kB/s to some 100 MB/s are neither idle
//! nor flooded. The fleet tests check that transfers end in time.

use std::time::Duration;

/// Maximum number of unacknowledged chunks to one receiver. This is well below what brokers queue for a slow client
/// (Mosquitto: 1000 messages).
pub(crate) const WINDOW_MAX: usize = 256;
/// Maximum number of their bytes, if that is less.
pub(crate) const WINDOW_BYTES_MAX: usize = 2 << 20;
/// The same number before anything is known of the line.
pub(crate) const WINDOW_FIRST: usize = 32;
/// The smallest such number on a slow line, and its bytes, if that is more. It must keep the line busy while a `Want` is on
/// its way, which the receiver sends after [`WANT_AFTER`].
pub(crate) const WINDOW_MIN: usize = 4;
/// The bytes of the smallest window.
pub(crate) const WINDOW_BYTES_MIN: usize = 32 << 10;
/// If the chunks of a full window take longer to be acknowledged than this, the window shrinks. What waits on a line is lost
/// when the line breaks.
pub(crate) const WINDOW_SLOW: Duration = Duration::from_secs(6);
/// If they take less than this, it grows.
pub(crate) const WINDOW_FAST: Duration = Duration::from_secs(1);

/// A receiver sends a `Want` after this many new chunks. A `Want` also acknowledges the chunks that have arrived. On a
/// good link, it reaches the sender before the sender's window is full.
pub(crate) const WANT_EVERY: u32 = WINDOW_FIRST as u32 / 2;
/// On a slow line, it sends one when a chunk arrives and the last one was sent so long ago.
pub(crate) const WANT_AFTER: Duration = Duration::from_secs(2);

/// A sender makes chunks smaller if fewer than this have got through from one break of the connection to the next. With a
/// higher number, what a broker has queued for a slow receiver would be sent again in smaller chunks for little.
pub(crate) const CHUNKS_PER_CONNECTION: u32 = 2;
/// Messages that tell of a connection within this time of another one tell of the same connection.
pub(crate) const SAME_CONNECTION: Duration = Duration::from_millis(500);
/// How many times smaller.
pub(crate) const SHRINK: u32 = 4;
/// A receiver that asked for chunks within this time knows the offer, even if it has been connected anew since.
pub(crate) const OFFER_KNOWN: Duration = Duration::from_secs(5);

/// A chunk counts as lost once a chunk that was sent more than this many places later has arrived. The margin
/// tolerates reordering.
pub(crate) const REORDER: u64 = 3;

/// Delays after which a sender without a reply offers its model again.
pub(crate) const ANNOUNCE: Backoff = Backoff::new(Duration::from_secs(2), Duration::from_secs(30));
/// The same delays after a reply. On a slow line the next one comes after [`WANT_AFTER`] and the time of a chunk: an offer
/// before would only take the time of another chunk.
pub(crate) const ANNOUNCE_ANSWERED: Backoff = Backoff::new(Duration::from_secs(5), Duration::from_secs(30));

/// Shortest time between two offers of a global model because devices may lack it.
pub(crate) const ANNOUNCE_AGAIN: Duration = Duration::from_secs(1);

/// Lower limit of the time without a new chunk after which a receiver assumes that no more chunks are on their
/// way.
pub(crate) const IDLE_MIN: Duration = Duration::from_secs(1);
/// Upper limit of the time without a new chunk after which a receiver assumes that no more chunks are on their
/// way, and of the delay between two `Want`s.
pub(crate) const IDLE_MAX: Duration = Duration::from_secs(60);
/// A receiver's first estimate of the time between two chunks: about the time that 64 KiB take at 100 kB/s. If
/// no chunk arrives after the first `Want`, the second `Want` follows after this time.
pub(crate) const FIRST_GAP: Duration = Duration::from_millis(600);
/// If no chunk arrives for this many average gaps between chunks, a receiver assumes that no more chunks are
/// on their way.
pub(crate) const IDLE_GAPS: u32 = 8;

/// Delays after which storing a model is tried again, for example on a full disk.
pub(crate) const STORE_RETRY: Backoff = Backoff::new(Duration::from_secs(5), Duration::from_secs(60));

/// An unfinished model without a new chunk for this long is dropped if another model needs its room.
pub(crate) const STALLED: Duration = Duration::from_secs(60);
/// An unfinished model of which no chunk has arrived for this long after its header is dropped if another model needs its
/// room.
pub(crate) const NEVER_BEGUN: Duration = Duration::from_secs(10);
/// A header that contradicts that of an unfinished model replaces it only if no chunk has arrived for this long. So
/// headers of strangers do not disturb a transfer that gets on.
pub(crate) const REPLACEABLE: Duration = Duration::from_secs(10);
/// How long an unfinished model waits before it asks again for more room.
pub(crate) const ROOM_RETRY: Duration = Duration::from_secs(2);

/// The time in which a receiver may have a whole body sent again.
pub(crate) const RESEND_ALL: Duration = Duration::from_secs(30);
/// Shortest time between two requests of a receiver that show no new chunk. Further ones are ignored.
pub(crate) const REPEATED_WANT: Duration = Duration::from_millis(400);
/// Delays after which an aggregator asks again for a model that it has lost.
pub(crate) const ASK_AGAIN: Backoff = Backoff::new(Duration::from_secs(2), Duration::from_secs(60));
/// Delays after which a device repeats the pledge of its flight that the aggregator does not confirm.
pub(crate) const PLEDGE: Backoff = Backoff::new(Duration::from_secs(2), Duration::from_secs(60));
/// Shortest time between two lists of confirmed flights to one device.
pub(crate) const CONFIRM_PAUSE: Duration = Duration::from_secs(1);
/// Delays after which a device that waits for its cell of the plan asks again.
pub(crate) const PLAN_ASK: Backoff = Backoff::new(Duration::from_millis(500), Duration::from_secs(2));
/// How often it asks again after a connection. An aggregator that starts later answers without being asked.
pub(crate) const PLAN_ASKS_MAX: u32 = 3;
/// Shortest time between two answers about the plan to one device.
pub(crate) const PLAN_PAUSE: Duration = Duration::from_secs(1);
/// A device that waits for a global model offers its stored model again so often, and when it is connected again: an
/// aggregator that has lost the model and its own records cannot ask.
pub(crate) const STORED_OFFER: Duration = Duration::from_secs(60);
/// Shortest time between two such offers because of new connections. On a line that breaks each second, offers and what the
/// aggregator answers would fill the line, and a broker repeats on each connection what was not acknowledged on the last one.
pub(crate) const STORED_AGAIN: Duration = Duration::from_secs(10);
/// A device answers such a request at most once in this time.
pub(crate) const ASKED_AGAIN: Duration = Duration::from_secs(5);
/// Limit on the numbers that a sender tries for one model, the next twice as high as the last.
pub(crate) const RENUMBERED_MAX: u32 = 48;
/// Where nobody signs, a device's model with a number below one that is stored is refused only if that one is below this.
/// A sender reaches all such numbers, so a forged high number bans nobody.
pub(crate) const NUMBERS_IN_REACH: u64 = 1 << 40;
/// An upload without a reply after this many offers, about half a minute, is reported.
pub(crate) const UNANSWERED_OFFERS: u32 = 5;
/// An unfinished model without a new chunk for this long is dropped even if no model needs its room.
pub(crate) const ABANDONED: Duration = Duration::from_secs(3600);

/// A receiver refuses a model if the hash is still wrong after the body was fetched this many times.
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
