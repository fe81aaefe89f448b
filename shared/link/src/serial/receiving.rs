//! What comes in: pieces in any order, put together to messages.

use std::collections::{BTreeMap, VecDeque};

use cosurf_wire::frame::{Piece, Turn, WINDOW_PIECES};

use super::letter::MAX_LETTER_BYTES;

/// Whole messages that wait for their owner; then the window fills, and the other side waits.
const WHOLE_MAX: usize = 64;

/// Messages coming from one direction. It holds at most the window, one unfinished message, and
/// [`WHOLE_MAX`] whole ones.
#[derive(Debug, Default)]
pub(super) struct Receiving {
    /// Number of the first piece that has not been put together.
    next: u32,
    /// Pieces from `next` on.
    ahead: BTreeMap<u32, (Vec<u8>, bool)>,
    message: Vec<u8>,
    /// The unfinished message is longer than any may be: it is thrown away at its end.
    is_too_long: bool,
    whole: VecDeque<Vec<u8>>,
    /// Pieces have come since the other side was told last.
    pub(super) has_news: bool,
}

impl Receiving {
    /// Whether nothing has come yet.
    pub(super) fn is_fresh(&self) -> bool {
        self.next == 0 && self.ahead.is_empty()
    }

    /// Takes a piece; what is known or beyond the window changes nothing.
    pub(super) fn take(&mut self, piece: &Piece<'_>) {
        self.has_news = true;
        if piece.number.checked_sub(self.next).is_some_and(|offset| offset < WINDOW_PIECES) {
            self.ahead.entry(piece.number).or_insert_with(|| (piece.payload.to_vec(), piece.is_last));
        }
        self.put_together();
    }

    /// The next whole message.
    pub(super) fn message(&mut self) -> Option<Vec<u8>> {
        let message = self.whole.pop_front();
        self.put_together();
        message
    }

    /// Says what is here.
    pub(super) fn describe(&mut self, turn: &mut Turn) {
        self.has_news = false;
        turn.next = self.next;
        turn.here.clear();
        let Some(last) = self.ahead.last_key_value().map(|(number, _)| number - self.next) else { return };
        // The window is no longer than the bits, so there is room.
        let _ = turn.here.resize_default(last as usize / 8 + 1);
        for number in self.ahead.keys() {
            let offset = number - self.next;
            turn.here[offset as usize / 8] |= 1 << (offset % 8);
        }
    }

    fn put_together(&mut self) {
        while self.whole.len() < WHOLE_MAX
            && let Some((payload, is_last)) = self.ahead.remove(&self.next)
        {
            self.next += 1;
            self.is_too_long |= self.message.len() + payload.len() > MAX_LETTER_BYTES;
            if !self.is_too_long {
                self.message.extend_from_slice(&payload);
            }
            if is_last {
                let message = std::mem::take(&mut self.message);
                if !std::mem::take(&mut self.is_too_long) {
                    self.whole.push_back(message);
                }
            }
        }
    }
}
