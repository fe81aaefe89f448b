//! What goes out: messages cut into pieces, each sent until it has arrived.

use std::collections::VecDeque;

use cosurf_wire::frame::{MAX_PIECE_BYTES, Piece, Turn, WINDOW_PIECES};

/// Bytes that wait to be cut into pieces before no more are taken. Ours: enough that a turn never runs dry
/// between two looks of the owner, little enough that news does not wait long behind.
const QUEUE_BYTES: usize = 32 * 1024;

/// A piece lost so often is sent twice in a turn: it is about to stop the window.
const TRIES: u8 = 3;

/// Messages under way in one direction.
#[derive(Debug, Default)]
pub(super) struct Sending {
    /// From the oldest that has not wholly arrived.
    messages: VecDeque<Message>,
    /// Those that are not wholly cut yet; of the first, `cut` bytes are.
    queue: VecDeque<Vec<u8>>,
    queue_bytes: usize,
    cut: usize,
    /// Number of the first of `under_way`.
    base: u32,
    under_way: VecDeque<Sent>,
    /// Pieces that did not arrive, in order.
    again: VecDeque<u32>,
}

#[derive(Debug)]
struct Message {
    /// Tells whether a message is under way already.
    hash: blake3::Hash,
    /// Its last piece, once it is cut.
    last: Option<u32>,
}

#[derive(Debug)]
struct Sent {
    payload: Vec<u8>,
    is_last: bool,
    is_here: bool,
    /// How often it was lost.
    losses: u8,
}

impl Sending {
    /// Whether nothing was sent yet.
    pub(super) fn is_fresh(&self) -> bool {
        self.base == 0 && self.under_way.is_empty()
    }

    /// Whether one more message is taken.
    pub(super) fn has_room(&self) -> bool {
        self.queue_bytes < QUEUE_BYTES
    }

    /// Takes a message, unless the very same is on its way: the line loses nothing, so it will arrive.
    pub(super) fn queue(&mut self, message: Vec<u8>) {
        let hash = blake3::hash(&message);
        if self.messages.iter().any(|under_way| under_way.hash == hash) {
            return;
        }
        self.messages.push_back(Message { hash, last: None });
        self.queue_bytes += message.len();
        self.queue.push_back(message);
    }

    /// Whether there is a piece to send.
    pub(super) fn has_more(&self) -> bool {
        !self.again.is_empty() || (!self.queue.is_empty() && self.under_way.len() < WINDOW_PIECES as usize)
    }

    /// The next piece: first what was lost, then what is new.
    pub(super) fn next(&mut self) -> Option<Piece<'_>> {
        let number = match self.again.pop_front() {
            Some(number) => number,
            None => self.cut()?,
        };
        let Sent { payload, is_last, .. } = self.under_way.get((number - self.base) as usize)?;
        Some(Piece { number, is_last: *is_last, payload })
    }

    /// The other side says what it has. Whatever was sent before it spoke has arrived by now or is lost.
    /// `false` where it claims what was never sent.
    pub(super) fn on_turn(&mut self, turn: &Turn) -> bool {
        if !self.on_late_turn(turn) {
            return false;
        }
        self.again.clear();
        let mut once_more = Vec::new();
        for (number, sent) in (self.base..).zip(&mut self.under_way).filter(|(_, sent)| !sent.is_here) {
            sent.losses = sent.losses.saturating_add(1);
            self.again.push_back(number);
            once_more.extend((sent.losses >= TRIES).then_some(number));
        }
        self.again.extend(once_more);
        true
    }

    /// The same, but more may have been sent since it was said.
    pub(super) fn on_late_turn(&mut self, turn: &Turn) -> bool {
        if turn.next > self.base + self.under_way.len() as u32 {
            return false;
        }
        let base = self.base;
        for (offset, sent) in self.under_way.iter_mut().enumerate() {
            sent.is_here |= turn.has(base + offset as u32);
        }
        while self.under_way.front().is_some_and(|sent| sent.is_here) {
            self.under_way.pop_front();
            self.base += 1;
        }
        self.again.retain(|number| {
            number.checked_sub(self.base).is_some_and(|offset| !self.under_way[offset as usize].is_here)
        });
        while self.messages.front().is_some_and(|message| message.last.is_some_and(|last| last < self.base)) {
            self.messages.pop_front();
        }
        true
    }

    /// Cuts one more piece off the queue; returns its number.
    fn cut(&mut self) -> Option<u32> {
        if self.under_way.len() >= WINDOW_PIECES as usize {
            return None;
        }
        let message = self.queue.front()?;
        let end = message.len().min(self.cut + MAX_PIECE_BYTES);
        let payload = message[self.cut..end].to_vec();
        let is_last = end == message.len();
        self.queue_bytes -= payload.len();
        self.cut = end;
        let number = self.base + self.under_way.len() as u32;
        if is_last {
            self.queue.pop_front();
            self.cut = 0;
            if let Some(message) = self.messages.iter_mut().find(|message| message.last.is_none()) {
                message.last = Some(number);
            }
        }
        self.under_way.push_back(Sent { payload, is_last, is_here: false, losses: 0 });
        Some(number)
    }
}
