//! Forged frames on a serial line. A neighbour hears the line, and sends frames in the name of its ends. Once
//! he stops, the line recovers by itself within seconds.
#![allow(clippy::unwrap_used)]

use std::time::Duration;

use cosurf_link::Faults;
use cosurf_link::faults::Dice;
use cosurf_link::serial::ArqEvent;
use cosurf_tests::radio::{Air, BYTES_PER_S, joined, pattern, radio};
use cosurf_wire::frame::{Frame, Piece, Sessions, Turn, WINDOW_PIECES};

const MESSAGES: usize = 40;
const MESSAGE_BYTES: usize = 2000;
const SEEDS: u64 = 20;
/// A line carries all messages in this time at 70 % of its bandwidth, and recovers in ten seconds of it.
const TIME_MAX: Duration = Duration::from_millis(
    (MESSAGES * MESSAGE_BYTES) as u64 * 1000 / BYTES_PER_S.get() as u64 * 10 / 7 + 10_000,
);

/// The owner of the first end. He sends the messages that have not arrived again when the line begins anew,
/// like the transfers of models.
struct Upload {
    air: Air,
    messages: Vec<Vec<u8>>,
    next: usize,
    events: usize,
}

impl Upload {
    fn new(seed: u64, loss: f64) -> Self {
        let bytes = pattern(MESSAGES * MESSAGE_BYTES);
        let numbered = |(i, part): (usize, &[u8])| [&(i as u32).to_le_bytes()[..], part].concat();
        let messages = bytes.chunks(MESSAGE_BYTES).enumerate().map(numbered).collect();
        Self { air: Air::new(seed, radio(loss)), messages, next: 0, events: 0 }
    }

    fn step(&mut self) {
        let air = &mut self.air;
        if air.events[0].len() > self.events {
            (self.next, self.events) = (0, air.events[0].len());
        }
        while air.ends[0].has_room()
            && let Some(message) = self.messages.get(self.next)
        {
            if !air.received[1].contains(message) {
                air.ends[0].queue(message.clone());
            }
            self.next += 1;
        }
        air.step();
    }

    fn arrived(&self) -> usize {
        self.messages.iter().filter(|message| self.air.received[1].contains(message)).count()
    }

    fn run_until(&mut self, is_reached: impl Fn(&Air) -> bool) {
        while !is_reached(&self.air) {
            self.step();
            assert!(self.air.now < Duration::from_secs(300), "never reached");
        }
    }

    /// Runs until all messages have arrived. The owner also repeats them after ten seconds in which nothing
    /// has arrived, if `may_repeat`: a receiver of chunks asks for them.
    fn finish(&mut self, what: &str, may_repeat: bool) {
        let begun = self.air.now;
        let (mut news, mut news_at) = (self.air.received[1].len(), begun);
        while self.arrived() < MESSAGES {
            self.step();
            if self.air.received[1].len() > news {
                (news, news_at) = (self.air.received[1].len(), self.air.now);
            } else if may_repeat && self.air.now > news_at + Duration::from_secs(10) {
                (self.next, news_at) = (0, self.air.now);
            }
            let (took, arrived) = (self.air.now - begun, self.arrived());
            assert!(took < TIME_MAX, "{what}: {arrived} of {MESSAGES} messages after {took:?}");
        }
    }

    /// Checks that only messages of the owner have arrived, and each session's messages in order.
    fn check_order(&self) {
        let place = |message| self.messages.iter().position(|sent| sent == message);
        let places: Vec<usize> = self.air.received[1].iter().map(|message| place(message).unwrap()).collect();
        let steps_back = places.windows(2).filter(|pair| pair[1] <= pair[0]).count();
        let sessions = self.air.events[1].iter().filter(|event| **event == ArqEvent::Linked).count();
        assert!(steps_back < sessions, "{places:?} in {sessions} sessions");
    }

    /// Forges a turn to an end, in the name of the other end.
    fn forge_turn(&mut self, end: usize, number: u32, next: u32) {
        let sessions = self.air.sessions(1 - end);
        let turn = Turn { sessions, number, next, has_more: true, ..Turn::default() };
        self.air.forge(end, &Frame::Turn(turn), sessions);
    }

    fn turn_number(&self) -> u32 {
        self.air.turns[0].number.max(self.air.turns[1].number)
    }
}

/// An uploader in the middle of its transfer.
fn under_way(seed: u64) -> Upload {
    let mut upload = Upload::new(seed, 0.05);
    upload.run_until(|air| air.received[1].len() >= 5);
    upload
}

#[test]
fn a_forged_turn_number_does_not_end_a_line() {
    for seed in 0..SEEDS {
        for ahead in [2, 50, 1000, u32::MAX / 2 - 1, u32::MAX / 2, u32::MAX - 1, u32::MAX] {
            for end in 0..2 {
                let mut upload = under_way(seed);
                let number = upload.turn_number().max(ahead);
                // Twice, because a side that has just begun a session waits before it begins another.
                upload.forge_turn(end, number, 0);
                upload.step();
                upload.forge_turn(end, number, 0);
                upload.finish(&format!("seed {seed}, turn {number} to end {end}"), false);
                upload.check_order();
            }
        }
    }
}

/// A session of a neighbour begins at the highest number, so that its next turn reaches the limit.
#[test]
fn turn_numbers_that_reach_their_limit_begin_a_new_session() {
    for end in 0..2 {
        let mut upload = under_way(end as u64);
        let sessions = Sessions { sender: 77, receiver: 0 };
        let turn = Turn { sessions, number: u32::MAX / 2 - 1, ..Turn::default() };
        upload.air.forge(end, &Frame::Turn(turn), sessions);
        upload.finish(&format!("end {end}"), false);
        upload.check_order();
    }
}

/// A line on which this piece of the first session never arrives.
fn jammed(seed: u64, piece: u32) -> Upload {
    let mut upload = Upload::new(seed, 0.05);
    upload.run_until(|air| air.turns[0].sessions.sender != 0);
    upload.air.jammed = Some((upload.air.turns[0].sessions.sender, piece));
    upload
}

#[test]
fn a_forged_acknowledgement_of_a_jammed_piece_does_not_end_a_line() {
    for seed in 0..SEEDS {
        let mut upload = jammed(seed, 60);
        upload.run_until(|air| air.pieces[0] > 60);
        let number = upload.turn_number();
        upload.run_until(|air| air.turns[0].number > number);
        let next = upload.air.pieces[0];
        upload.forge_turn(0, number + 2, next);
        upload.finish(&format!("seed {seed}"), false);
        upload.check_order();
    }
}

/// Both sides agree, and turns pass, but one piece never arrives.
#[test]
fn a_line_without_progress_begins_a_new_session() {
    for seed in 0..SEEDS {
        let mut upload = jammed(seed, 60);
        upload.run_until(|air| air.events[0].len() > 1);
        upload.finish(&format!("seed {seed}"), false);
        upload.check_order();
    }
}

/// The owner of the second end takes no messages for minutes. The first end waits, and loses nothing.
#[test]
fn an_owner_who_is_busy_for_minutes_causes_no_new_session() {
    let mut air = Air::new(1, radio(0.05));
    air.is_busy = true;
    let sent = pattern(600_000);
    let mut parts = sent.chunks(2000).zip(0u32..).peekable();
    let busy_until = Duration::from_secs(900);
    while air.received[1].len() < 300 {
        while air.ends[0].has_room()
            && let Some((part, number)) = parts.next()
        {
            air.ends[0].queue([&number.to_le_bytes()[..], part].concat());
        }
        air.is_busy = air.now < busy_until;
        air.step();
        assert!(air.now < busy_until + Duration::from_secs(200), "{} arrived", air.received[1].len());
    }
    assert!(joined(&air.received[1]) == sent);
    assert_eq!(air.events, [[ArqEvent::Linked], [ArqEvent::Linked]]);
}

#[test]
fn forged_pieces_ahead_of_the_sender_do_not_end_a_line() {
    for seed in 0..SEEDS {
        let mut upload = under_way(seed);
        let (first, sessions) = (upload.air.pieces[0], upload.air.sessions(0));
        for number in first + 1..=first + WINDOW_PIECES {
            let piece = Piece { number, is_last: true, payload: &[0] };
            upload.air.forge(1, &Frame::Piece(piece), sessions);
            while upload.air.ends[1].next_message().is_some() {}
        }
        let last = Piece { number: first, is_last: true, payload: &[0] };
        upload.air.forge(1, &Frame::Piece(last), sessions);
        while upload.air.ends[1].next_message().is_some() {}
        upload.finish(&format!("seed {seed}"), false);
    }
}

/// The forged piece replaces the first piece of a message, so the message arrives garbled. The true piece
/// arrives later and does not agree.
#[test]
fn a_forged_piece_in_place_of_a_true_one_begins_a_new_session() {
    for seed in 0..SEEDS {
        let mut upload = Upload::new(seed, 0.0);
        upload.run_until(|air| air.pieces[0] > 30);
        let (number, sessions) = (upload.air.pieces[0] - 1, upload.air.sessions(0));
        let piece = Piece { number, is_last: false, payload: &[0] };
        upload.air.forge(1, &Frame::Piece(piece), sessions);
        upload.finish(&format!("seed {seed}"), false);
    }
}

/// The sender would later count the jammed piece as arrived.
#[test]
fn a_forged_piece_before_a_jammed_true_one_begins_a_new_session() {
    for seed in 0..SEEDS {
        let mut upload = jammed(seed, 350);
        upload.run_until(|air| air.pieces[0] > 20);
        let piece = Piece { number: 350, is_last: false, payload: &[0] };
        let sessions = upload.air.sessions(0);
        upload.air.forge(1, &Frame::Piece(piece), sessions);
        upload.finish(&format!("seed {seed}"), false);
    }
}

/// The forged piece may also wait behind a lost one when the true one arrives.
#[test]
fn most_forged_pieces_are_noticed_on_a_lossy_line() {
    let mut noticed = 0;
    for seed in 0..SEEDS {
        let mut upload = Upload::new(seed, 0.05);
        upload.run_until(|air| air.pieces[0] > 60);
        let (number, sessions) = (upload.air.pieces[0] - 1, upload.air.sessions(0));
        let piece = Piece { number, is_last: false, payload: &[0] };
        upload.air.forge(1, &Frame::Piece(piece), sessions);
        upload.finish(&format!("seed {seed}"), true);
        noticed += usize::from(upload.air.events[1].len() > 1);
    }
    assert!(noticed as u64 >= SEEDS * 3 / 4, "{noticed} of {SEEDS}");
}

#[test]
fn an_echo_of_own_turns_causes_no_new_session() {
    let mut upload = under_way(2);
    for _ in 0..100 {
        for end in 0..2 {
            let turn = Frame::Turn(upload.air.turns[end].clone());
            upload.air.forge(end, &turn, upload.air.sessions(end));
        }
        upload.step();
    }
    upload.finish("echo", false);
    assert_eq!(upload.air.events, [[ArqEvent::Linked], [ArqEvent::Linked]]);
}

/// Session numbers come from the clock, so two sides that start in the same second have the same number.
#[test]
fn two_sides_with_the_same_session_number_link() {
    for seed in 0..300 {
        let faults = Faults { delay_max: Duration::from_millis(150), ..radio(0.05) };
        let mut air = Air::new(seed, faults);
        air.restart(0, 5000);
        air.send_all(&pattern(2000), 500);
        assert!(air.now < Duration::from_secs(30), "seed {seed}: {:?}", air.now);
    }
}

#[test]
fn events_that_nobody_reads_do_not_pile_up() {
    let mut air = Air::new(1, radio(0.0));
    for sender in 1..1000 {
        let sessions = Sessions { sender, receiver: 5000 };
        let turn = Turn { sessions, number: 1, ..Turn::default() };
        air.forge(1, &Frame::Turn(turn), sessions);
    }
    let events = std::iter::from_fn(|| air.ends[1].next_event()).count();
    assert_eq!(events, 1);
}

/// A random frame of a neighbour: mostly with true session numbers, and with numbers near the true ones.
fn forge_any(upload: &mut Upload, dice: &mut Dice) {
    let end = dice.below(2) as usize;
    let mut sessions = upload.air.sessions(1 - end);
    match dice.below(8) {
        0 => sessions.receiver = 0,
        1 => sessions.sender = dice.next_bits() as u32,
        2 => sessions.receiver = dice.next_bits() as u32,
        _ => {}
    }
    let mut near = |number: u32| match dice.below(4) {
        0 => dice.next_bits() as u32,
        1 => number.saturating_add(dice.below(2000) as u32),
        2 => number.saturating_sub(dice.below(10) as u32),
        _ => number.saturating_add(dice.below(4) as u32),
    };
    let piece = near(upload.air.pieces[1 - end]);
    let (number, next) = (near(upload.turn_number()), near(upload.air.pieces[end]));
    if dice.chance(0.5) {
        let payload = [dice.next_bits() as u8; 3];
        let piece = Piece { number: piece, is_last: dice.chance(0.5), payload: &payload };
        upload.air.forge(end, &Frame::Piece(piece), sessions);
        return;
    }
    let mut turn = Turn { sessions, number, next, has_more: dice.chance(0.5), ..Turn::default() };
    let bits = (0..dice.below(20)).map(|_| dice.next_bits() as u8);
    bits.for_each(|byte| turn.received.push(byte).unwrap());
    upload.air.forge(end, &Frame::Turn(turn), sessions);
}

#[test]
fn a_line_recovers_from_random_forged_frames() {
    for seed in 0..300 {
        let (mut upload, mut dice) = (Upload::new(seed, 0.05), Dice::new(seed));
        let mut forge_at = Duration::ZERO;
        let until = Duration::from_secs(2 + seed % 20);
        while upload.air.now < until {
            upload.step();
            while forge_at < upload.air.now {
                forge_any(&mut upload, &mut dice);
                forge_at += Duration::from_millis(1 + dice.below(20 << (seed % 6)));
            }
        }
        upload.finish(&format!("seed {seed}"), true);
    }
}

/// Lets a neighbour forge frames at every step for 20 s. Few sessions begin, because each lasts a while.
fn few_sessions(forge: impl Fn(&mut Upload, usize)) {
    let mut upload = under_way(1);
    let begun = upload.air.now;
    let (mut sessions, mut changes) = (upload.air.sessions(0), 0);
    while upload.air.now < begun + Duration::from_secs(20) {
        (0..2).for_each(|end| forge(&mut upload, end));
        upload.step();
        changes += u32::from(upload.air.sessions(0) != sessions);
        sessions = upload.air.sessions(0);
    }
    assert!(changes < 45, "{changes} new sessions of both ends in 20 s");
    upload.finish("few sessions", false);
}

#[test]
fn forged_sessions_do_not_begin_one_after_the_other() {
    few_sessions(|upload, end| {
        let sender = upload.air.now.as_micros() as u32 | 1 << 31;
        let forged = Sessions { sender, receiver: 0 };
        let turn = Turn { sessions: forged, number: 1, ..Turn::default() };
        upload.air.forge(end, &Frame::Turn(turn), forged);
        // A piece in the name of the forged session, so that the session does not remain without pieces.
        let pair = Sessions { sender, receiver: upload.air.turns[end].sessions.sender };
        let piece = Piece { number: 0, is_last: false, payload: &[1] };
        upload.air.forge(end, &Frame::Piece(piece), pair);
    });
}

#[test]
fn forged_disagreements_do_not_begin_one_session_after_the_other() {
    few_sessions(|upload, end| {
        let sessions = upload.air.sessions(1 - end);
        for payload in [[1], [2]] {
            let piece = Piece { number: 0, is_last: false, payload: &payload };
            upload.air.forge(end, &Frame::Piece(piece), sessions);
        }
        let number = upload.turn_number() + 1;
        upload.forge_turn(end, number, 0);
    });
}
