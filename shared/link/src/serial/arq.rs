//! A selective-repeat ARQ (automatic repeat request) for a half-duplex line that loses, damages and delays
//! frames. It reads no clock and has no port: the caller passes the time and the frames that have arrived,
//! and gets the frames to send.
//!
//! The side that may send *has the floor*. It sends pieces of messages at the line's bandwidth, first the
//! lost ones, then new ones, for at most [`BURST_ROUNDS`] round trips. Then it sends a [`Turn`], which
//! acknowledges pieces and passes the floor. A turn is sent [`COPIES`] times, because losing it is expensive.
//! A turn answers a burst of pieces that were all sent before it. Each of these pieces has therefore either
//! arrived or is lost, and pieces need no timers.
//!
//! A side that gets no answer repeats its turn, with exponential backoff. Only the newest turn passes the
//! floor. Once both sides know each other's sessions, never more than one side has the floor. Before that,
//! both sides may send turns, but no pieces.
//!
//! After an outage both sides continue where they stopped. After a restart of one side, its session number is
//! new. Both sides then start from the beginning, and the caller gets an event.
//!
//! Anyone in range can forge frames. They may leave the two sides with different ideas of what has arrived. A
//! side that notices this by an impossible frame, or because nothing arrives any more, begins a new session
//! as if it had restarted, but at most once every [`SESSION_MIN`]. So a line recovers once nobody forges
//! frames any more.

use std::collections::VecDeque;
use std::num::NonZeroU32;
use std::time::Duration;

use cosurf_wire::frame::{Frame, MAX_FRAME_BYTES, Sessions, Turn};

use super::receiving::Receiving;
use super::sending::Sending;
use crate::faults::Dice;

/// Number of copies of each turn. With 20 % loss, all three copies are lost in one of 125 turns.
const COPIES: u8 = 3;
/// A side keeps the floor for at most this many round trips. Passing the floor takes one round trip, so it
/// costs 2 % of the bandwidth.
const BURST_ROUNDS: u32 = 50;
/// A side with pieces to send may keep the floor for this long even if [`BURST_ROUNDS`] round trips are
/// shorter.
const BURST_MIN: Duration = Duration::from_millis(500);
/// A side with pieces to send keeps the floor for at most this long even if [`BURST_ROUNDS`] round trips are
/// longer.
const BURST_MAX: Duration = Duration::from_secs(10);
/// A side with nothing to send keeps the floor for this long before it passes the floor.
const IDLE: Duration = Duration::from_secs(2);
/// Round-trip time assumed before the first measurement.
const FIRST_ROUND_TRIP: Duration = Duration::from_secs(1);
/// Added to the timeout of an answer, in case the other side's thread wakes up late. Also the longest wait for
/// the remaining copies of the other side's turn.
const GRACE: Duration = Duration::from_millis(200);
/// A turn is repeated if no answer comes within some time. This is the upper limit of that time. [`IDLE`]
/// and a random part are added to the limited time.
const REPEAT_MAX: Duration = Duration::from_secs(5);
/// The line counts as lost after this long without a valid frame.
const LOST_AFTER: Duration = Duration::from_secs(30);
/// A session lasts at least this long, unless nothing was exchanged in it. A neighbour who forges frames
/// therefore cannot make both sides begin one session after the other without a pause.
const SESSION_MIN: Duration = Duration::from_secs(1);
/// Numbers of turns stay below this. Honest sides do not reach it in a hundred years. A side that reaches it,
/// because somebody forges turns, begins a new session.
const TURN_NUMBER_MAX: u32 = u32::MAX / 2;
/// How far frames may be sent ahead of the line's bandwidth. Such frames keep the line busy while the thread
/// wakes up late on a busy computer. They fit into the buffers of radios (SiK) and ports.
const AHEAD: Duration = Duration::from_millis(200);

/// An event of a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ArqEvent {
    /// The other side answers. Messages that were queued earlier may be lost.
    Linked,
    /// The other side has been silent for [`LOST_AFTER`]. Transfers continue when it answers again.
    Lost,
}

/// The side that has the floor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Floor {
    /// This side has had the floor since time `from`. `has_sent` is set after the first piece.
    Ours { from: Duration, has_sent: bool },
    /// This side is passing the floor. It still has to send `copies` copies of its turn.
    Passing { copies: u8 },
    /// The other side has the floor. It got the floor or last sent a frame at time `since`.
    Theirs { since: Duration },
}

/// One end of a line: it sends and receives messages.
///
/// # Examples
///
/// ```
/// use std::num::NonZeroU32;
/// use std::time::Duration;
///
/// use cosurf_link::serial::Arq;
///
/// let bandwidth = NonZeroU32::new(5760).expect("not zero");
/// let mut ends = [Arq::new(1, bandwidth), Arq::new(2, bandwidth)];
/// ends[0].queue(b"hello".to_vec());
///
/// // A line without loss or delay, on virtual time.
/// let mut now = Duration::ZERO;
/// let received = loop {
///     for (sender, receiver) in [(0, 1), (1, 0)] {
///         while let Some(frame) = ends[sender].next_frame(now) {
///             let mut frame = frame.to_vec();
///             let without_zero = frame.len() - 1;
///             ends[receiver].on_frame(now, &mut frame[..without_zero]);
///         }
///     }
///     if let Some(message) = ends[1].next_message() {
///         break message;
///     }
///     now += Duration::from_millis(10);
///     assert!(now < Duration::from_secs(10), "the message arrives");
/// };
/// assert_eq!(received, b"hello");
/// ```
#[derive(Debug)]
pub struct Arq {
    /// The session numbers of both sides. The sender is this side.
    sessions: Sessions,
    /// Whether the other side knows this side's session.
    is_confirmed: bool,
    /// Whether the two sides cannot have the same idea of what has arrived. The line then needs a new session.
    is_broken: bool,
    /// From this time on, this side may begin another session.
    may_renew_at: Duration,
    is_up: bool,
    heard_at: Duration,
    sending: Sending,
    receiving: Receiving,
    floor: Floor,
    /// Number of the newest turn of either side.
    turn_number: u32,
    /// Whether this side sent the newest turn.
    is_own_turn: bool,
    /// Whether the other side has more to send, and therefore waits for the floor.
    is_awaited: bool,
    /// Whether the other side must answer the last turn without delay. Otherwise the answer does not measure
    /// the round-trip time.
    is_prompt: bool,
    /// Moving average of the time from the end of this side's turn to the first frame of the answer.
    round_trip: Duration,
    /// When the last turn was completely sent; `None` once it is answered.
    turn_sent_at: Option<Duration>,
    repeats: u32,
    pace: Pace,
    dice: Dice,
    events: VecDeque<ArqEvent>,
    out: [u8; MAX_FRAME_BYTES],
}

impl Arq {
    /// Makes one end of a line with the given bandwidth. `session` must differ from the number of this side's
    /// previous session.
    pub fn new(session: u32, bytes_per_s: NonZeroU32) -> Self {
        let session = session.max(1);
        Self {
            sessions: Sessions { sender: session, receiver: 0 },
            is_confirmed: false,
            is_broken: false,
            may_renew_at: Duration::ZERO,
            is_up: false,
            heard_at: Duration::ZERO,
            sending: Sending::default(),
            receiving: Receiving::default(),
            floor: Floor::Ours { from: Duration::ZERO, has_sent: false },
            turn_number: 0,
            is_own_turn: true,
            is_awaited: false,
            is_prompt: false,
            round_trip: FIRST_ROUND_TRIP,
            turn_sent_at: None,
            repeats: 0,
            pace: Pace { bytes_per_s, free_at: Duration::ZERO },
            dice: Dice::new(u64::from(session)),
            events: VecDeque::new(),
            out: [0; MAX_FRAME_BYTES],
        }
    }

    /// Whether another message may be queued: the other side has answered in this session, and the queue has
    /// room.
    pub fn has_room(&self) -> bool {
        self.is_confirmed && self.sending.has_room()
    }

    /// Queues a message for sending, unless an identical one is still queued or on its way.
    pub fn queue(&mut self, message: Vec<u8>) {
        self.sending.queue(message);
    }

    /// Returns the next message that has arrived.
    pub fn next_message(&mut self) -> Option<Vec<u8>> {
        self.receiving.next_message()
    }

    /// Returns the next event.
    pub fn next_event(&mut self) -> Option<ArqEvent> {
        self.events.pop_front()
    }

    /// Takes a frame that has arrived, without its final zero. A damaged frame is dropped.
    pub fn on_frame(&mut self, now: Duration, frame: &mut [u8]) {
        if let Floor::Theirs { since } = &mut self.floor {
            // Any frame, even a damaged one, shows that the other side is sending.
            *since = now;
        }
        let sessions = Sessions { sender: self.sessions.receiver, receiver: self.sessions.sender };
        let bytes = frame.len();
        let is_answer = match Frame::decode(frame, sessions) {
            Ok(Frame::Piece(piece)) if self.sessions.receiver != 0 => {
                self.is_broken |= !self.receiving.take(&piece);
                // The checksum of a piece covers the session numbers of both sides, so the other side knows
                // this session.
                self.confirm(now);
                true
            }
            Ok(Frame::Turn(turn)) => self.on_turn(now, &turn, bytes),
            _ => return,
        };
        self.repeats = 0;
        if let Some(sent_at) = self.turn_sent_at.take_if(|_| is_answer)
            && self.is_prompt
        {
            self.round_trip = (self.round_trip + now.saturating_sub(sent_at)) / 2;
        }
    }

    /// Returns the next frame that is due. The caller must send it: it counts as sent.
    pub fn next_frame(&mut self, now: Duration) -> Option<&[u8]> {
        if self.is_up && now.saturating_sub(self.heard_at) > LOST_AFTER {
            self.is_up = false;
            self.events.push_back(ArqEvent::Lost);
        }
        if now < self.next_wakeup() {
            return None;
        }
        let needs_renewal = self.is_broken || self.turn_number >= TURN_NUMBER_MAX;
        if needs_renewal && now >= self.may_renew_at && !matches!(self.floor, Floor::Passing { .. }) {
            self.renew(now);
        }
        match self.floor {
            Floor::Ours { from, .. } => {
                let may_continue = self.is_confirmed && now.saturating_sub(from) < self.burst();
                match may_continue.then(|| self.sending.next()).flatten() {
                    Some(piece) => {
                        self.floor = Floor::Ours { from, has_sent: true };
                        return Some(self.pace.send(now, Frame::Piece(piece), self.sessions, &mut self.out));
                    }
                    None => (self.turn_number, self.is_own_turn) = (self.turn_number + 1, true),
                }
                Some(self.send_turn(now, COPIES))
            }
            Floor::Passing { copies } => Some(self.send_turn(now, copies)),
            Floor::Theirs { .. } => {
                self.repeats += 1;
                Some(self.send_turn(now, COPIES))
            }
        }
    }

    /// Time at which [`Self::next_frame`] next has a frame, if no frame arrives before.
    pub fn next_wakeup(&self) -> Duration {
        let next = match self.floor {
            Floor::Ours { from, has_sent } => {
                let is_urgent = !self.is_confirmed
                    || has_sent
                    || self.is_awaited
                    || self.receiving.has_unacknowledged
                    || self.sending.has_more();
                from + if is_urgent { Duration::ZERO } else { IDLE }
            }
            Floor::Passing { .. } => Duration::ZERO,
            Floor::Theirs { since } => since + self.turn_timeout(),
        };
        next.max(self.pace.ready_at())
    }

    /// Sends one copy of the turn. `copies` is the number of copies left to send, with this one.
    fn send_turn(&mut self, now: Duration, copies: u8) -> &[u8] {
        let copies_left = copies - 1;
        let mut turn = Turn {
            sessions: self.sessions,
            number: self.turn_number,
            copies_left,
            has_more: self.sending.has_more(),
            ..Turn::default()
        };
        self.receiving.acknowledge(&mut turn);
        let frame = self.pace.send(now, Frame::Turn(turn), self.sessions, &mut self.out);
        if copies_left > 0 {
            self.floor = Floor::Passing { copies: copies_left };
        } else {
            self.turn_sent_at = Some(self.pace.free_at);
            self.is_prompt = self.is_awaited || self.sending.has_more();
            self.floor = Floor::Theirs { since: self.pace.free_at };
            self.is_awaited = false;
        }
        frame
    }

    /// Records that the other side knows this side's session.
    fn confirm(&mut self, now: Duration) {
        self.heard_at = now;
        self.is_confirmed = true;
        if !self.is_up {
            self.is_up = true;
            // One event suffices while the caller reads none. Without this, the queue would not be bounded.
            if self.events.back() != Some(&ArqEvent::Linked) {
                self.events.push_back(ArqEvent::Linked);
            }
        }
    }

    /// Handles a turn. Returns whether it passes the floor to this side.
    fn on_turn(&mut self, now: Duration, turn: &Turn, bytes: usize) -> bool {
        if turn.sessions.sender == 0 || turn.number >= TURN_NUMBER_MAX {
            return false;
        }
        let is_new_session = turn.sessions.sender != self.sessions.receiver;
        if is_new_session && !self.join(now, turn.sessions.sender) {
            return false;
        }
        let knows_us = turn.sessions.receiver == self.sessions.sender;
        if knows_us {
            self.confirm(now);
        }
        // The other side knows only an earlier session of this side, whose turns were counted differently.
        let is_stale = !knows_us && turn.sessions.receiver != 0;
        // At the start both sides may send turns with the same number. The turn of the side with the higher
        // session number then counts as newer.
        let wins_tie = self.is_own_turn && turn.sessions.sender > self.sessions.sender;
        let is_newest = turn.number > self.turn_number || (turn.number == self.turn_number && wins_tie);
        if !is_new_session && (is_stale || !is_newest) {
            self.on_old_turn(now, turn, knows_us, is_stale);
            return false;
        }
        if knows_us && !self.sending.on_turn(turn) {
            self.is_broken = true;
            if now < self.may_renew_at {
                return false;
            }
        } else if !is_stale {
            (self.turn_number, self.is_own_turn) = (turn.number, false);
        }
        self.is_awaited = turn.has_more;
        let copies_time = self.pace.time_of(bytes) * u32::from(turn.copies_left);
        self.floor = Floor::Ours { from: now + copies_time.min(GRACE), has_sent: false };
        true
    }

    /// Handles a turn that is not the newest. Either it is a late copy, or the other side has not received
    /// this side's newest turn. In the second case, the newest turn is sent again. A stale turn is always of
    /// the second case.
    fn on_old_turn(&mut self, now: Duration, turn: &Turn, knows_us: bool, is_stale: bool) {
        if knows_us {
            self.sending.on_late_turn(turn);
        }
        self.is_awaited |= turn.has_more;
        let is_behind = is_stale || turn.number < self.turn_number;
        let is_turn_lost = self.turn_sent_at.map_or(is_stale, |sent_at| now > sent_at + 2 * self.round_trip);
        if is_behind && is_turn_lost && matches!(self.floor, Floor::Theirs { .. }) {
            self.floor = Floor::Passing { copies: COPIES };
        }
    }

    /// Starts from the beginning, because the other side has a new session, with this number. If pieces were
    /// already exchanged, this side also begins a new session, so that old frames fail their checksums.
    /// Returns whether this side has joined the session. It waits for a repeated turn if its own session is
    /// too young, and ignores an echo.
    fn join(&mut self, now: Duration, session: u32) -> bool {
        let is_echo = session == self.sessions.sender;
        if self.sending.is_fresh() && self.receiving.is_fresh() {
            if is_echo {
                // Both sides have the same number. Neither of their turns would win a tie.
                self.sessions.sender = self.next_session(now);
            }
        } else if is_echo || now < self.may_renew_at {
            return false;
        } else {
            self.renew(now);
        }
        self.sessions.receiver = session;
        self.is_confirmed = false;
        self.is_up = false;
        true
    }

    /// Begins a new session. Forgets all messages, as a restart does, and counts turns from the beginning.
    fn renew(&mut self, now: Duration) {
        self.sessions.sender = self.next_session(now);
        self.sending = Sending::default();
        self.receiving = Receiving::default();
        self.is_confirmed = false;
        self.is_broken = false;
        self.is_up = false;
        self.may_renew_at = now + SESSION_MIN;
        self.floor = Floor::Ours { from: now, has_sent: false };
        (self.turn_number, self.is_own_turn) = (0, true);
        self.turn_sent_at = None;
        self.repeats = 0;
    }

    /// Draws the number of a new session. It differs from the numbers of both sides. It is not the next
    /// number, which the caller may use after a restart. The time makes it differ from a number that the other
    /// side draws.
    fn next_session(&mut self, now: Duration) -> u32 {
        let Sessions { sender, receiver } = self.sessions;
        self.dice = Dice::new(self.dice.next_bits() ^ now.as_nanos() as u64);
        loop {
            let session = self.dice.next_bits() as u32;
            if ![0, sender, receiver].contains(&session) {
                return session;
            }
        }
    }

    /// The longest time that this side may keep the floor.
    fn burst(&self) -> Duration {
        (self.round_trip * BURST_ROUNDS).clamp(BURST_MIN, BURST_MAX)
    }

    /// Time without an answer after which the turn is repeated. A part of it is drawn from this side's
    /// session number, so that the two sides do not keep colliding.
    fn turn_timeout(&self) -> Duration {
        let base = 2 * self.round_trip + GRACE;
        let idle = if self.sending.has_more() || !self.is_confirmed { Duration::ZERO } else { IDLE };
        let wait = (base * (1 << self.repeats.min(6))).min(REPEAT_MAX) + idle;
        let spread = self.dice.clone().below(512) + 64 * u64::from(self.repeats % 5);
        wait + wait * spread as u32 / 1024
    }
}

/// A token bucket that limits frames to the line's bandwidth.
#[derive(Debug)]
struct Pace {
    bytes_per_s: NonZeroU32,
    /// When the line will have finished sending the last frame.
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
