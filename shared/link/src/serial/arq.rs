//! Selective repeat in turns: two ends of a line that loses, damages and delays, and on which only one may
//! speak at a time. No clock, no port: it takes the time and frames, and returns frames.
//!
//! One side has the floor: it sends pieces at the line's pace, first those that were lost, then new ones,
//! for at most fifty times what handing over costs; then a [`Turn`], three times, since it must not be
//! lost. The turn tells what has arrived; so each turn settles the fate of every piece sent before it, and
//! no piece has a timer. A side that hears nothing where it should repeats its turn, ever more rarely; only
//! the newest turn gives the floor, so there is never more than one. After an outage both go on where they
//! were. After a restart of one side its session's number is another one: both begin anew, and the owner
//! is told.

use std::collections::VecDeque;
use std::num::NonZeroU32;
use std::time::Duration;

use cosurf_wire::frame::{Frame, MAX_FRAME_BYTES, Sessions, Turn};

use super::receiving::Receiving;
use super::sending::Sending;
use crate::faults::Dice;

/// A turn is said so often: at 20 % loss one in 125 is lost.
const COPIES: u8 = 3;
/// A side keeps the floor at most so many times the time of handing it over: 2 % are lost by that.
const TURNS: u32 = 50;
const BURST_MIN: Duration = Duration::from_millis(500);
const BURST_MAX: Duration = Duration::from_secs(10);
/// A side with nothing to say keeps the floor for so long.
const IDLE: Duration = Duration::from_secs(2);
/// What handing over takes before it was measured.
const FIRST_ROUND: Duration = Duration::from_secs(1);
/// Beyond twice that time the other side may have been slow to wake.
const GRACE: Duration = Duration::from_millis(200);
/// Longest wait before a turn is repeated.
const REPEAT_MAX: Duration = Duration::from_secs(5);
/// Without a word for so long the line is told to be lost.
const LOST: Duration = Duration::from_secs(30);
/// How far frames may be ahead of the pace: what a thread on a busy computer oversleeps, and less than
/// what radios (SiK) and ports hold.
const AHEAD: Duration = Duration::from_millis(200);

/// What a line tells its owner beside messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ArqEvent {
    /// The other side answers. What was on its way before may be lost.
    Linked,
    /// The other side has not been heard for a while. What is on its way goes on when it is.
    Lost,
}

/// Who may speak.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Floor {
    /// This side, from then on.
    Ours { from: Duration, has_spoken: bool },
    /// This side says its turn, so many times more.
    Giving { copies: u8 },
    /// The other side; it was heard, or given the floor, then.
    Theirs { since: Duration },
}

/// One end of a line.
#[derive(Debug)]
pub struct Arq {
    /// As this side sends.
    sessions: Sessions,
    /// The other side knows this session.
    is_confirmed: bool,
    is_up: bool,
    heard_at: Duration,
    sending: Sending,
    receiving: Receiving,
    floor: Floor,
    /// Of the newest turn.
    number: u32,
    /// This side said it.
    is_own: bool,
    /// The other side waits for the floor.
    is_awaited: bool,
    /// The other side knows this one to wait, so it answers a turn at once.
    is_prompt: bool,
    /// What handing over and back takes.
    round: Duration,
    /// When the last turn was out, until it is answered.
    asked_at: Option<Duration>,
    repeats: u32,
    pace: Pace,
    dice: Dice,
    events: VecDeque<ArqEvent>,
    out: [u8; MAX_FRAME_BYTES],
}

impl Arq {
    /// An end whose session has a number of its own, on a line that takes so many bytes a second.
    pub fn new(session: u32, bytes_per_s: NonZeroU32) -> Self {
        let session = session.max(1);
        Self {
            sessions: Sessions { sender: session, receiver: 0 },
            is_confirmed: false,
            is_up: false,
            heard_at: Duration::ZERO,
            sending: Sending::default(),
            receiving: Receiving::default(),
            floor: Floor::Ours { from: Duration::ZERO, has_spoken: false },
            number: 0,
            is_own: true,
            is_awaited: false,
            is_prompt: false,
            round: FIRST_ROUND,
            asked_at: None,
            repeats: 0,
            pace: Pace { bytes_per_s, free_at: Duration::ZERO },
            dice: Dice::new(u64::from(session)),
            events: VecDeque::new(),
            out: [0; MAX_FRAME_BYTES],
        }
    }

    /// Whether one more message is taken: the other side answers, and not too many wait.
    pub fn has_room(&self) -> bool {
        self.is_confirmed && self.sending.has_room()
    }

    /// Takes a message to send; one that is on its way already is not sent twice.
    pub fn queue(&mut self, message: Vec<u8>) {
        self.sending.queue(message);
    }

    /// The next message that arrived.
    pub fn message(&mut self) -> Option<Vec<u8>> {
        self.receiving.message()
    }

    /// What else happened.
    pub fn event(&mut self) -> Option<ArqEvent> {
        self.events.pop_front()
    }

    /// Takes a frame without its final zero; what is damaged is lost.
    pub fn hear(&mut self, now: Duration, frame: &mut [u8]) {
        if let Floor::Theirs { since } = &mut self.floor {
            // Somebody speaks, whatever it is.
            *since = now;
        }
        let sessions = Sessions { sender: self.sessions.receiver, receiver: self.sessions.sender };
        let bytes = frame.len();
        let is_news = match Frame::decode(frame, sessions) {
            Ok(Frame::Piece(piece)) if self.sessions.receiver != 0 => {
                self.receiving.take(&piece);
                // Its checksum was made with our number.
                self.confirm(now);
                true
            }
            Ok(Frame::Turn(turn)) => self.hear_turn(now, &turn, bytes),
            _ => return,
        };
        self.repeats = 0;
        if let Some(asked_at) = self.asked_at.take_if(|_| is_news)
            && self.is_prompt
        {
            self.round = (self.round + now.saturating_sub(asked_at)) / 2;
        }
    }

    /// The next frame, if it is time for one. What is handed out here must be sent.
    pub fn next_frame(&mut self, now: Duration) -> Option<&[u8]> {
        if self.is_up && now.saturating_sub(self.heard_at) > LOST {
            self.is_up = false;
            self.events.push_back(ArqEvent::Lost);
        }
        if now < self.next_wakeup() {
            return None;
        }
        match self.floor {
            Floor::Ours { from, .. } => {
                let may_go_on = self.is_confirmed && now.saturating_sub(from) < self.burst();
                match may_go_on.then(|| self.sending.next()).flatten() {
                    Some(piece) => {
                        self.floor = Floor::Ours { from, has_spoken: true };
                        return Some(self.pace.send(now, Frame::Piece(piece), self.sessions, &mut self.out));
                    }
                    None => (self.number, self.is_own) = (self.number + 1, true),
                }
                Some(self.say_turn(now, COPIES))
            }
            Floor::Giving { copies } => Some(self.say_turn(now, copies)),
            Floor::Theirs { .. } => {
                self.repeats += 1;
                Some(self.say_turn(now, COPIES))
            }
        }
    }

    /// When [`Self::next_frame`] has something although nothing is heard.
    pub fn next_wakeup(&self) -> Duration {
        let next = match self.floor {
            Floor::Ours { from, has_spoken } => {
                let is_urgent = !self.is_confirmed
                    || has_spoken
                    || self.is_awaited
                    || self.receiving.has_news
                    || self.sending.has_more();
                from + if is_urgent { Duration::ZERO } else { IDLE }
            }
            Floor::Giving { .. } => Duration::ZERO,
            Floor::Theirs { since } => since + self.patience(),
        };
        next.max(self.pace.ready_at())
    }

    fn say_turn(&mut self, now: Duration, copies: u8) -> &[u8] {
        let copies_left = copies - 1;
        let mut turn = Turn {
            sessions: self.sessions,
            number: self.number,
            copies_left,
            has_more: self.sending.has_more(),
            ..Turn::default()
        };
        self.receiving.describe(&mut turn);
        let frame = self.pace.send(now, Frame::Turn(turn), self.sessions, &mut self.out);
        if copies_left > 0 {
            self.floor = Floor::Giving { copies: copies_left };
        } else {
            self.asked_at = Some(self.pace.free_at);
            self.is_prompt = self.is_awaited || self.sending.has_more();
            self.floor = Floor::Theirs { since: self.pace.free_at };
            self.is_awaited = false;
        }
        frame
    }

    /// The other side has shown that it knows this session.
    fn confirm(&mut self, now: Duration) {
        self.heard_at = now;
        self.is_confirmed = true;
        if !self.is_up {
            self.is_up = true;
            self.events.push_back(ArqEvent::Linked);
        }
    }

    /// Returns whether it gives the floor.
    fn hear_turn(&mut self, now: Duration, turn: &Turn, bytes: usize) -> bool {
        if turn.sessions.sender == 0 {
            return false;
        }
        let is_other = turn.sessions.sender != self.sessions.receiver;
        if is_other {
            self.begin_anew(turn);
        }
        let knows_us = turn.sessions.receiver == self.sessions.sender;
        if knows_us {
            self.confirm(now);
        }
        // At the start both may speak at once under one number: the higher session goes first.
        let is_tie_won = self.is_own && turn.sessions.sender > self.sessions.sender;
        let is_newest = turn.number > self.number || (turn.number == self.number && is_tie_won);
        if !is_other && !is_newest {
            self.hear_old_turn(now, turn, knows_us);
            return false;
        }
        if knows_us && !self.sending.on_turn(turn) {
            return false;
        }
        (self.number, self.is_own) = (turn.number, false);
        self.is_awaited = turn.has_more;
        let copies = self.pace.time_of(bytes) * u32::from(turn.copies_left);
        self.floor = Floor::Ours { from: now + copies.min(GRACE), has_spoken: false };
        true
    }

    /// A turn that gives nothing any more: a late copy, or the other side has not heard ours.
    fn hear_old_turn(&mut self, now: Duration, turn: &Turn, knows_us: bool) {
        if knows_us {
            self.sending.on_late_turn(turn);
        }
        self.is_awaited |= turn.has_more;
        let has_not_heard = self.asked_at.is_some_and(|asked_at| now > asked_at + 2 * self.round);
        if turn.number < self.number && has_not_heard && matches!(self.floor, Floor::Theirs { .. }) {
            self.floor = Floor::Giving { copies: COPIES };
        }
    }

    /// The other side is another one than before. If anything has passed between the two, this side takes
    /// another number too, so that nothing of then is taken for something of now.
    fn begin_anew(&mut self, turn: &Turn) {
        if !(self.sending.is_fresh() && self.receiving.is_fresh()) {
            self.sessions.sender = self.sessions.sender.checked_add(1).unwrap_or(1);
            self.sending = Sending::default();
            self.receiving = Receiving::default();
        }
        self.sessions.receiver = turn.sessions.sender;
        self.is_confirmed = false;
        self.is_up = false;
    }

    fn burst(&self) -> Duration {
        (self.round * TURNS).clamp(BURST_MIN, BURST_MAX)
    }

    /// How long to listen before the turn is repeated. The two sides must not do so at the same time again
    /// and again.
    fn patience(&self) -> Duration {
        let once = 2 * self.round + GRACE;
        let idle = if self.sending.has_more() || !self.is_confirmed { Duration::ZERO } else { IDLE };
        let wait = (once * (1 << self.repeats.min(6))).min(REPEAT_MAX) + idle;
        let spread = self.dice.clone().below(512) + 64 * u64::from(self.repeats % 5);
        wait + wait * spread as u32 / 1024
    }
}

/// A token bucket: frames leave at the line's pace.
#[derive(Debug)]
struct Pace {
    bytes_per_s: NonZeroU32,
    /// When the last frame has left.
    free_at: Duration,
}

impl Pace {
    fn ready_at(&self) -> Duration {
        self.free_at.saturating_sub(AHEAD)
    }

    fn time_of(&self, bytes: usize) -> Duration {
        Duration::from_secs_f64(bytes as f64 / f64::from(self.bytes_per_s.get()))
    }

    fn send<'o>(
        &mut self,
        now: Duration,
        frame: Frame<'_>,
        sessions: Sessions,
        out: &'o mut [u8; MAX_FRAME_BYTES],
    ) -> &'o [u8] {
        let bytes = frame.encode(sessions, out);
        self.free_at = self.free_at.max(now) + self.time_of(bytes.len());
        bytes
    }
}
