//! Frames of a serial line. They carry messages over a radio, which may lose and damage bytes.
//!
//! A message is cut into *pieces* with consecutive numbers. Only the side that has the *floor* may send.
//! When it has used its share of the line, it sends a *turn*. The turn acknowledges the pieces that have
//! arrived, and gives the floor to the other side. The two sides therefore never send at the same time, as
//! half-duplex radios require.
//!
//! | Frame | Bytes before the CRC |
//! |---|---|
//! | piece | 0, its number (varint), payload |
//! | last piece of a message | 1, its number (varint), payload |
//! | turn | 2, [`FRAME_VERSION`], [`Turn`] in postcard |
//!
//! The CRC-32 of these bytes follows, little-endian. Then all bytes are encoded without zeros (COBS), and a
//! zero byte ends the frame. The CRC of a piece also covers the session numbers of both sides, which the
//! piece does not contain. A piece from before a restart therefore fails its CRC.

use heapless::Vec;
use serde::{Deserialize, Serialize};

use crate::cobs;

/// Version of the frame format. Every turn contains this version.
pub const FRAME_VERSION: u8 = 1;
/// Largest payload of a piece, bytes. The frame of a piece then fits one packet of a SiK radio (at most 252
/// bytes).
pub const MAX_PIECE_BYTES: usize = 200;
/// Maximum number of unacknowledged pieces in one direction, and of bits in [`Turn::received`]. A radio at
/// 57,600 baud sends this many pieces in about five of its turns. A piece that is lost four times in a row
/// therefore does not hold back new pieces.
pub const WINDOW_PIECES: u32 = 1400;
/// Size in bytes of the largest frame, with its final zero: the frame of a full piece. A test checks it.
pub const MAX_FRAME_BYTES: usize = MAX_RAW_BYTES + 2;
/// Largest frame before stuffing (COBS), bytes. Below 254, so stuffing adds one byte.
const MAX_RAW_BYTES: usize = 210;
const CHECKSUM_BYTES: usize = 4;
const RECEIVED_BYTES: usize = WINDOW_PIECES as usize / 8;

const PIECE: u8 = 0;
const LAST_PIECE: u8 = 1;
const TURN: u8 = 2;

/// The session numbers of both sides, as one side knows them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Sessions {
    /// Session of the side that sends the frame.
    pub sender: u32,
    /// Session of the side that receives the frame; 0 while the sender does not know it.
    pub receiver: u32,
}

/// A frame of a serial line.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Frame<'a> {
    /// Part of a message.
    Piece(Piece<'a>),
    /// Acknowledges pieces, and gives the floor (the right to send) to the other side.
    Turn(Turn),
}

/// Part of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Piece<'a> {
    /// Number of the piece in the sender's session, from 0.
    pub number: u32,
    /// Whether this is the last piece of the message.
    pub is_last: bool,
    /// The piece's bytes of the message, at most [`MAX_PIECE_BYTES`].
    pub payload: &'a [u8],
}

/// Acknowledges pieces, and gives the floor (the right to send) to the other side.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Turn {
    /// The sessions of both sides, as the sender knows them.
    pub sessions: Sessions,
    /// Number of the turn. The turns of both sides are counted together. A repeated turn keeps its number.
    pub number: u32,
    /// Number of copies of this turn that follow. The other side waits for the time that the copies take
    /// before it sends.
    pub copies_left: u8,
    /// Whether the sender has more to send when it gets the floor back.
    pub has_more: bool,
    /// The side that sends the turn has received all pieces below this number.
    pub next: u32,
    /// Bitmap of the pieces from `next` on, lowest bit first: a set bit means that the piece has arrived.
    /// Pieces beyond the bitmap have not arrived.
    pub received: Vec<u8, RECEIVED_BYTES>,
}

/// Why bytes are not a valid frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum FrameError {
    /// The CRC does not match: the bytes changed in transit or belong to another session.
    Damaged,
    /// The bytes encode no frame of this version.
    Malformed,
}

impl core::fmt::Display for FrameError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::Damaged => "frame damaged in transit, or of another session",
            Self::Malformed => "malformed frame, or of another version",
        })
    }
}

impl core::error::Error for FrameError {}

impl Turn {
    /// Whether the side that sends the turn has received piece `number`.
    pub fn has(&self, number: u32) -> bool {
        let Some(offset) = number.checked_sub(self.next) else { return true };
        self.received.get(offset as usize / 8).is_some_and(|byte| byte >> (offset % 8) & 1 == 1)
    }
}

impl Frame<'_> {
    /// Writes the encoded frame and the zero byte that ends it to `out`, from its start, and returns the
    /// written bytes. `sessions` are the session numbers as this side, the sender, knows them.
    pub fn encode<'o>(&self, sessions: Sessions, out: &'o mut [u8; MAX_FRAME_BYTES]) -> &'o [u8] {
        let mut raw = [0; MAX_RAW_BYTES];
        let used = self.write(&mut raw);
        let (content, rest) = raw.split_at_mut(used);
        let checksum = checksum(self.salt(sessions), content).to_le_bytes();
        rest[..CHECKSUM_BYTES].copy_from_slice(&checksum);
        // Cannot fail: a test encodes the largest frames.
        let stuffed = cobs::encode(&raw[..used + CHECKSUM_BYTES], out).unwrap_or(0);
        out[stuffed] = 0;
        &out[..=stuffed]
    }

    fn write(&self, raw: &mut [u8; MAX_RAW_BYTES]) -> usize {
        let written = match self {
            Self::Piece(piece) => {
                raw[0] = if piece.is_last { LAST_PIECE } else { PIECE };
                postcard::to_slice(&piece.number, &mut raw[1..]).map(|number| 1 + number.len()).map(|head| {
                    let payload = &piece.payload[..piece.payload.len().min(MAX_PIECE_BYTES)];
                    raw[head..head + payload.len()].copy_from_slice(payload);
                    head + payload.len()
                })
            }
            Self::Turn(turn) => {
                raw[..2].copy_from_slice(&[TURN, FRAME_VERSION]);
                postcard::to_slice(turn, &mut raw[2..]).map(|turn| 2 + turn.len())
            }
        };
        written.unwrap_or(0)
    }

    fn salt(&self, sessions: Sessions) -> Sessions {
        match self {
            Self::Piece(_) => sessions,
            Self::Turn(_) => Sessions::default(),
        }
    }
}

impl<'a> Frame<'a> {
    /// Decodes a frame in place. `bytes` is the frame without its final zero. `sessions` are the session
    /// numbers as the sender of the frame knows them.
    pub fn decode(bytes: &'a mut [u8], sessions: Sessions) -> Result<Self, FrameError> {
        let used = cobs::decode_in_place(bytes).ok_or(FrameError::Damaged)?;
        let (content, found) = bytes[..used].split_last_chunk().ok_or(FrameError::Damaged)?;
        let (kind, rest) = content.split_first().ok_or(FrameError::Damaged)?;
        let salt = if *kind == TURN { Sessions::default() } else { sessions };
        if checksum(salt, content) != u32::from_le_bytes(*found) {
            return Err(FrameError::Damaged);
        }
        match *kind {
            PIECE | LAST_PIECE => {
                let (number, payload) = postcard::take_from_bytes(rest).map_err(|_| FrameError::Malformed)?;
                if payload.len() > MAX_PIECE_BYTES {
                    return Err(FrameError::Malformed);
                }
                Ok(Self::Piece(Piece { number, is_last: *kind == LAST_PIECE, payload }))
            }
            TURN => match rest.split_first() {
                Some((&FRAME_VERSION, turn)) => match postcard::take_from_bytes(turn) {
                    Ok((turn, [])) => Ok(Self::Turn(turn)),
                    _ => Err(FrameError::Malformed),
                },
                _ => Err(FrameError::Malformed),
            },
            _ => Err(FrameError::Malformed),
        }
    }
}

fn checksum(salt: Sessions, content: &[u8]) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(&salt.sender.to_le_bytes());
    hasher.update(&salt.receiver.to_le_bytes());
    hasher.update(content);
    hasher.finalize()
}

/// Splits a stream of bytes into frames. Drops every sequence of bytes that is too long for a frame.
#[derive(Debug)]
pub struct FrameReader {
    bytes: [u8; MAX_FRAME_BYTES],
    used: usize,
}

impl Default for FrameReader {
    fn default() -> Self {
        Self { bytes: [0; MAX_FRAME_BYTES], used: 0 }
    }
}

impl FrameReader {
    /// Takes the next byte of the stream. If the byte ends a frame, returns the frame without its final
    /// zero, as [`Frame::decode`] needs it.
    pub fn push(&mut self, byte: u8) -> Option<&mut [u8]> {
        if byte != 0 {
            if let Some(place) = self.bytes.get_mut(self.used) {
                *place = byte;
            }
            self.used = (self.used + 1).min(MAX_FRAME_BYTES + 1);
            return None;
        }
        let used = core::mem::take(&mut self.used);
        (used > 0).then(|| self.bytes.get_mut(..used)).flatten()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::vec::Vec as List;

    use super::*;

    const SESSIONS: Sessions = Sessions { sender: 7, receiver: 0x0102_0304 };

    fn turn() -> Turn {
        let received = Vec::from_slice(&[0b101, 0x80]).unwrap();
        Turn { sessions: SESSIONS, number: 300, copies_left: 2, has_more: true, next: 129, received }
    }

    fn largest_turn() -> Turn {
        let received = Vec::from_slice(&[0xFF; RECEIVED_BYTES]).unwrap();
        let sessions = Sessions { sender: u32::MAX, receiver: u32::MAX };
        Turn { sessions, number: u32::MAX, copies_left: u8::MAX, has_more: true, next: u32::MAX, received }
    }

    /// The encoded bytes of three frames. They must not change without a new [`FRAME_VERSION`].
    #[test]
    fn golden_bytes() {
        let piece = Frame::Piece(Piece { number: 300, is_last: false, payload: &[1, 0, 2] });
        let last = Frame::Piece(Piece { number: 0, is_last: true, payload: &[] });
        let golden: [(Frame<'_>, &str); 3] = [
            (piece, "0104ac0201060276f2509000"),
            (last, "02010534d8b76f00"),
            (Frame::Turn(turn()), "1502010784868808ac020201810102058081668c7200"),
        ];
        for (frame, bytes) in golden {
            let mut out = [0; MAX_FRAME_BYTES];
            let hex: std::string::String =
                frame.encode(SESSIONS, &mut out).iter().map(|byte| std::format!("{byte:02x}")).collect();
            assert_eq!(hex, bytes, "{frame:?}");
        }
    }

    #[test]
    fn every_frame_round_trips_and_none_exceeds_the_maximum() {
        let payload: List<u8> = (0..MAX_PIECE_BYTES).map(|i| i as u8).collect();
        let number = u32::MAX;
        let frames = [
            Frame::Piece(Piece { number, is_last: false, payload: &payload }),
            Frame::Piece(Piece { number, is_last: true, payload: &[0; MAX_PIECE_BYTES] }),
            Frame::Turn(turn()),
            Frame::Turn(largest_turn()),
        ];
        let mut longest = 0;
        for frame in frames {
            let (mut out, mut reader) = ([0; MAX_FRAME_BYTES], FrameReader::default());
            let bytes = frame.encode(SESSIONS, &mut out);
            longest = longest.max(bytes.len());
            assert!(bytes[..bytes.len() - 1].iter().all(|byte| reader.push(*byte).is_none()));
            assert_eq!(Frame::decode(reader.push(0).unwrap(), SESSIONS), Ok(frame));
        }
        assert_eq!(longest, MAX_FRAME_BYTES);
    }

    #[test]
    fn any_changed_bit_or_truncation_is_detected() {
        let payload: List<u8> = (0..MAX_PIECE_BYTES).map(|i| (i * 7) as u8).collect();
        let mut out = [0; MAX_FRAME_BYTES];
        for frame in
            [Frame::Piece(Piece { number: 5, is_last: true, payload: &payload }), Frame::Turn(turn())]
        {
            let bytes = frame.encode(SESSIONS, &mut out);
            let bytes = &bytes[..bytes.len() - 1];
            for bit in 0..8 * bytes.len() {
                let mut changed = bytes.to_vec();
                changed[bit / 8] ^= 1 << (bit % 8);
                assert!(Frame::decode(&mut changed, SESSIONS).is_err(), "bit {bit}");
            }
            for end in 0..bytes.len() {
                assert!(Frame::decode(&mut bytes[..end].to_vec(), SESSIONS).is_err(), "end {end}");
            }
        }
    }

    #[test]
    fn a_piece_of_another_session_fails_its_checksum() {
        let mut out = [0; MAX_FRAME_BYTES];
        let frame = Frame::Piece(Piece { number: 5, is_last: true, payload: b"old" });
        let bytes = frame.encode(SESSIONS, &mut out);
        let mut bytes = bytes[..bytes.len() - 1].to_vec();
        let later = Sessions { receiver: SESSIONS.receiver + 1, ..SESSIONS };
        assert_eq!(Frame::decode(&mut bytes, later), Err(FrameError::Damaged));
    }

    #[test]
    fn endless_noise_is_dropped_and_the_next_frame_is_decoded() {
        let mut reader = FrameReader::default();
        assert!((0..10_000).all(|i| reader.push((i % 255 + 1) as u8).is_none()));
        assert!(reader.push(0).is_none(), "too long for a frame");
        let mut out = [0; MAX_FRAME_BYTES];
        let frame = Frame::Turn(turn());
        let bytes = frame.encode(SESSIONS, &mut out);
        assert!(bytes[..bytes.len() - 1].iter().all(|byte| reader.push(*byte).is_none()));
        assert_eq!(Frame::decode(reader.push(0).unwrap(), SESSIONS), Ok(frame));
    }

    #[test]
    fn a_turn_tells_for_each_piece_whether_it_arrived() {
        let turn = turn();
        let arrived: List<u32> = (125..150).filter(|number| turn.has(*number)).collect();
        assert_eq!(arrived, [125, 126, 127, 128, 129, 131, 144]);
    }
}
