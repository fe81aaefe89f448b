//! The receiving direction of a line: assembles messages from pieces, which may arrive in any order.

use std::collections::{BTreeMap, VecDeque};

use cosurf_wire::frame::{Piece, Turn, WINDOW_PIECES};

use super::packet::MAX_PACKET_BYTES;

/// Maximum number of complete messages that wait for the caller. While this many wait, the window of pieces
/// fills up and the other side must wait.
const COMPLETE_MAX: usize = 64;

/// The receiver's state. It holds at most one window of pieces, the digests of another window, one
/// unfinished message, and [`COMPLETE_MAX`] complete messages.
#[derive(Debug, Default)]
pub(super) struct Receiving {
    /// Number of the next piece to assemble.
    next: u32,
    /// Payloads of the pieces that are not assembled yet, by number, and whether each is the last of its
    /// message. An earlier piece is missing, or [`COMPLETE_MAX`] messages wait.
    ahead: BTreeMap<u32, (Vec<u8>, bool)>,
    /// Digests of the pieces that were assembled last, at most one window of them.
    assembled: VecDeque<u32>,
    message: Vec<u8>,
    /// Whether the unfinished message exceeds the maximum size. Such a message is dropped when its last piece
    /// arrives.
    is_too_long: bool,
    complete: VecDeque<Vec<u8>>,
    /// Whether a piece has arrived since this side last acknowledged pieces in a turn.
    pub(super) has_unacknowledged: bool,
}

impl Receiving {
    /// Whether no piece has arrived yet.
    pub(super) fn is_fresh(&self) -> bool {
        self.next == 0 && self.ahead.is_empty()
    }

    /// Takes a piece that has arrived. Ignores it if it is already known or lies beyond the window. Returns
    /// `false` if another piece with the same number has arrived before: one of the two is forged.
    pub(super) fn take(&mut self, piece: &Piece<'_>) -> bool {
        self.has_unacknowledged = true;
        let is_same = match piece.number.checked_sub(self.next) {
            None => {
                let from_end = (self.next - piece.number) as usize;
                let known = self.assembled.len().checked_sub(from_end).map(|place| self.assembled[place]);
                known.is_none_or(|known| known == digest(piece.payload, piece.is_last))
            }
            Some(offset) if offset < WINDOW_PIECES => {
                let new = || (piece.payload.to_vec(), piece.is_last);
                let (payload, is_last) = self.ahead.entry(piece.number).or_insert_with(new);
                payload == piece.payload && *is_last == piece.is_last
            }
            Some(_) => true,
        };
        self.assemble();
        is_same
    }

    /// The next complete message.
    pub(super) fn next_message(&mut self) -> Option<Vec<u8>> {
        let message = self.complete.pop_front();
        self.assemble();
        message
    }

    /// Writes to `turn` which pieces have arrived.
    pub(super) fn acknowledge(&mut self, turn: &mut Turn) {
        self.has_unacknowledged = false;
        turn.next = self.next;
        turn.received.clear();
        let Some(last) = self.ahead.last_key_value().map(|(number, _)| number - self.next) else { return };
        // Cannot fail: the bitmap of a turn has a bit for every piece of the window.
        let _ = turn.received.resize_default(last as usize / 8 + 1);
        for number in self.ahead.keys() {
            let offset = number - self.next;
            turn.received[offset as usize / 8] |= 1 << (offset % 8);
        }
    }

    fn assemble(&mut self) {
        while self.complete.len() < COMPLETE_MAX
            && let Some((payload, is_last)) = self.ahead.remove(&self.next)
        {
            self.next += 1;
            if self.assembled.len() >= WINDOW_PIECES as usize {
                self.assembled.pop_front();
            }
            self.assembled.push_back(digest(&payload, is_last));
            self.is_too_long |= self.message.len() + payload.len() > MAX_PACKET_BYTES;
            if !self.is_too_long {
                self.message.extend_from_slice(&payload);
            }
            if is_last {
                let message = std::mem::take(&mut self.message);
                if !std::mem::take(&mut self.is_too_long) {
                    self.complete.push_back(message);
                }
            }
        }
    }
}

fn digest(payload: &[u8], is_last: bool) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(&[u8::from(is_last)]);
    hasher.update(payload);
    hasher.finalize()
}
