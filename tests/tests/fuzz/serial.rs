//! Fuzzes the state machine of a serial line with frames that have valid checksums.

use std::num::NonZeroU32;
use std::time::Duration;

use cosurf_link::serial::Arq;
use cosurf_wire::frame::{Frame, MAX_FRAME_BYTES, MAX_PIECE_BYTES, Piece, Sessions, Turn};

use crate::runner::{Target, hammer};

/// The sessions of the other side, which sends, and of this side.
const SESSIONS: Sessions = Sessions { sender: 9, receiver: 5 };
/// The first byte of a turn.
const TURN: u8 = 2;

/// A frame without its stuffing and checksum.
fn content(frame: &Frame<'_>) -> Vec<u8> {
    let mut out = [0; MAX_FRAME_BYTES];
    let stuffed = frame.encode(SESSIONS, &mut out);
    let (mut at, mut raw) = (0, Vec::new());
    while stuffed[at] > 0 {
        let block = usize::from(stuffed[at]);
        raw.extend_from_slice(&stuffed[at + 1..at + block]);
        at += block;
        if block < 255 && stuffed[at] > 0 {
            raw.push(0);
        }
    }
    raw.truncate(raw.len() - 4);
    raw
}

/// Adds the checksum, and encodes without zeros (COBS).
fn stuffed(content: &[u8]) -> Vec<u8> {
    let salt = if content.first() == Some(&TURN) { Sessions::default() } else { SESSIONS };
    let salted = [&salt.sender.to_le_bytes()[..], &salt.receiver.to_le_bytes(), content].concat();
    let raw = [content, &crc32fast::hash(&salted).to_le_bytes()].concat();
    let mut out = Vec::new();
    for block in raw.split(|byte| *byte == 0) {
        for (i, part) in block.chunks(254).enumerate() {
            out.extend((i > 0).then_some(255));
            out.push(part.len() as u8 + 1);
            out.extend_from_slice(part);
        }
        out.extend(block.is_empty().then_some(1));
    }
    out
}

/// After each frame the line says when it is next due, and its memory is bounded.
#[test]
fn frames_with_valid_checksums_are_taken_or_refused() {
    let turn = |number, next| {
        let turn =
            Turn { sessions: SESSIONS, number, copies_left: 1, has_more: true, next, ..Turn::default() };
        content(&Frame::Turn(turn))
    };
    let piece =
        |number, is_last| content(&Frame::Piece(Piece { number, is_last, payload: &[7; MAX_PIECE_BYTES] }));
    let samples = vec![turn(3, 0), turn(70, 2), piece(0, false), piece(1, true), piece(900, false)];
    // A window of pieces and the complete messages that wait.
    let target = Target { name: "serial lines", samples, reseal: |_| (), bytes_max: |_| 1 << 20 };
    let make = || Arq::new(SESSIONS.receiver, NonZeroU32::new(5760).unwrap());
    let (mut line, mut now, mut frames) = (make(), Duration::ZERO, 0u64);
    hammer(target, move |bytes| {
        frames += 1;
        // After an impossible frame, the line begins a session of which later frames know nothing.
        if frames.is_multiple_of(20) {
            line = make();
        }
        now += Duration::from_millis(50);
        line.on_frame(now, &mut stuffed(bytes));
        if line.has_room() {
            line.queue(bytes.to_vec());
        }
        while line.next_event().is_some() {}
        let mut sent = 0;
        while line.next_frame(now).is_some() {
            sent += 1;
            assert!(sent < 1000, "it sends without end");
        }
        let mut has_message = false;
        while let Some(message) = line.next_message() {
            has_message = true;
            assert!(message.len() < 70_000);
        }
        has_message || frames <= 5
    });
}
