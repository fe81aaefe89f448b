//! The sending direction of a line: cuts messages into pieces, and sends each piece until it has arrived.

use std::collections::VecDeque;

use cosurf_wire::frame::{MAX_PIECE_BYTES, Piece, Turn, WINDOW_PIECES};

/// The queue accepts messages until it holds this many bytes. The line then does not run out of pieces before
/// the caller queues more, and an urgent message does not wait long behind others.
const QUEUE_BYTES: usize = 32 * 1024;

/// A piece that was lost this many times is sent twice in each burst. Until it arrives, the window cannot
/// move on, so new pieces would soon have to wait.
const LOSSES_BEFORE_DOUBLING: u8 = 3;
/// So many bursts without any arrival show that the line is broken. If half of the frames are lost, a single
/// piece gets through before, but for one in 10¹¹.
const FUTILE_BURSTS_MAX: u8 = 20;

/// The sender's state for one line.
#[derive(Debug, Default)]
pub(super) struct Sending {
    /// The oldest message that has not completely arrived, and all later ones, oldest first.
    messages: VecDeque<Message>,
    /// Messages that are not completely cut into pieces. Of the first message, `cut` bytes are already cut.
    queue: VecDeque<Vec<u8>>,
    queue_bytes: usize,
    cut: usize,
    /// Number of the first piece in `in_flight`.
    base: u32,
    /// The pieces that were sent, starting with the oldest one that has not arrived.
    in_flight: VecDeque<SentPiece>,
    /// Numbers of the lost pieces that are to be sent again, in the order of sending.
    lost: VecDeque<u32>,
    /// Number of the last bursts of which no piece has arrived.
    futile_bursts: u8,
}

#[derive(Debug)]
struct Message {
    /// Hash of the message. It detects duplicates.
    hash: blake3::Hash,
    /// Number of the message's last piece; `None` until the message is completely cut.
    last: Option<u32>,
}

#[derive(Debug)]
struct SentPiece {
    payload: Vec<u8>,
    is_last: bool,
    has_arrived: bool,
    /// Number of times that the piece was lost.
    losses: u8,
}

impl Sending {
    /// Whether no piece has been sent yet.
    pub(super) fn is_fresh(&self) -> bool {
        self.base == 0 && self.in_flight.is_empty()
    }

    /// Whether the queue accepts another message.
    pub(super) fn has_room(&self) -> bool {
        self.queue_bytes < QUEUE_BYTES
    }

    /// Queues a message. Does nothing if an identical message has not arrived yet: the line is reliable, so
    /// that message will arrive.
    pub(super) fn queue(&mut self, message: Vec<u8>) {
        let hash = blake3::hash(&message);
        if self.messages.iter().any(|queued| queued.hash == hash) {
            return;
        }
        self.messages.push_back(Message { hash, last: None });
        self.queue_bytes += message.len();
        self.queue.push_back(message);
    }

    /// Whether a piece can be sent now.
    pub(super) fn has_more(&self) -> bool {
        !self.lost.is_empty() || (!self.queue.is_empty() && self.in_flight.len() < WINDOW_PIECES as usize)
    }

    /// Returns the next piece to send: lost pieces first, then new ones.
    pub(super) fn next(&mut self) -> Option<Piece<'_>> {
        let number = match self.lost.pop_front() {
            Some(number) => number,
            None => self.cut()?,
        };
        let SentPiece { payload, is_last, .. } = self.in_flight.get((number - self.base) as usize)?;
        Some(Piece { number, is_last: *is_last, payload })
    }

    /// Handles the other side's newest turn. All pieces in flight were sent before it, so each has either
    /// arrived or is lost. Returns `false` if the two sides disagree on what has arrived, or if nothing
    /// arrives any more.
    pub(super) fn on_turn(&mut self, turn: &Turn) -> bool {
        if self.forgets(turn) {
            return false;
        }
        let was_sent = !self.in_flight.is_empty() && self.lost.front() != Some(&self.base);
        let arrived = self.arrived();
        if !self.on_late_turn(turn) {
            return false;
        }
        // The other side ignores pieces beyond its window while it waits for its caller.
        let is_open = self.base.saturating_sub(turn.next) < WINDOW_PIECES;
        if self.arrived() > arrived || !is_open {
            self.futile_bursts = 0;
        } else if was_sent {
            self.futile_bursts = self.futile_bursts.saturating_add(1);
        }
        self.lost.clear();
        let mut doubled = Vec::new();
        for (number, sent) in (self.base..).zip(&mut self.in_flight).filter(|(_, sent)| !sent.has_arrived) {
            sent.losses = sent.losses.saturating_add(1);
            self.lost.push_back(number);
            doubled.extend((sent.losses >= LOSSES_BEFORE_DOUBLING).then_some(number));
        }
        self.lost.extend(doubled);
        self.futile_bursts < FUTILE_BURSTS_MAX
    }

    /// Whether the newest turn lacks a piece that an earlier turn has acknowledged. One of the two is forged.
    fn forgets(&self, turn: &Turn) -> bool {
        let arrived = (self.base..).zip(&self.in_flight).filter(|(_, sent)| sent.has_arrived);
        (turn.next..self.base).chain(arrived.map(|(number, _)| number)).any(|number| !turn.has(number))
    }

    /// Number of all pieces that have arrived.
    fn arrived(&self) -> usize {
        self.base as usize + self.in_flight.iter().filter(|sent| sent.has_arrived).count()
    }

    /// Handles an older turn: records the pieces that have arrived. The other pieces may still be in flight.
    /// Returns `false` if the turn acknowledges pieces that were never sent.
    pub(super) fn on_late_turn(&mut self, turn: &Turn) -> bool {
        let sent = self.base + self.in_flight.len() as u32;
        if turn.next > sent || end_of(turn) > sent {
            return false;
        }
        let base = self.base;
        for (offset, sent) in self.in_flight.iter_mut().enumerate() {
            sent.has_arrived |= turn.has(base + offset as u32);
        }
        while self.in_flight.front().is_some_and(|sent| sent.has_arrived) {
            self.in_flight.pop_front();
            self.base += 1;
        }
        self.lost.retain(|number| {
            number.checked_sub(self.base).is_some_and(|offset| !self.in_flight[offset as usize].has_arrived)
        });
        while self.messages.front().is_some_and(|message| message.last.is_some_and(|last| last < self.base)) {
            self.messages.pop_front();
        }
        true
    }

    /// Cuts the next piece from the queue and returns its number.
    fn cut(&mut self) -> Option<u32> {
        if self.in_flight.len() >= WINDOW_PIECES as usize {
            return None;
        }
        let message = self.queue.front()?;
        let end = message.len().min(self.cut + MAX_PIECE_BYTES);
        let payload = message[self.cut..end].to_vec();
        let is_last = end == message.len();
        self.queue_bytes -= payload.len();
        self.cut = end;
        let number = self.base + self.in_flight.len() as u32;
        if is_last {
            self.queue.pop_front();
            self.cut = 0;
            if let Some(message) = self.messages.iter_mut().find(|message| message.last.is_none()) {
                message.last = Some(number);
            }
        }
        self.in_flight.push_back(SentPiece { payload, is_last, has_arrived: false, losses: 0 });
        Some(number)
    }
}

/// The number after the last piece that a turn acknowledges.
fn end_of(turn: &Turn) -> u32 {
    let last = turn.received.iter().rposition(|byte| *byte != 0);
    let bits = last.map_or(0, |byte| 8 * (byte as u32 + 1) - turn.received[byte].leading_zeros());
    turn.next.saturating_add(bits)
}
