//! A simulated serial line with both of its ends, on virtual time, and the faults of radios.

use std::collections::BTreeMap;
use std::num::NonZeroU32;
use std::time::Duration;

use cosurf_link::faults::Line;
use cosurf_link::serial::{Arq, ArqEvent};
use cosurf_link::{Faults, Outages};
use cosurf_wire::frame::{Frame, FrameReader, MAX_FRAME_BYTES, Sessions, Turn};

/// Bandwidth of the simulated radio: 57,600 baud, at 10 bits a byte.
pub const BYTES_PER_S: NonZeroU32 = NonZeroU32::new(5760).unwrap();

/// The faults of the radio in the acceptance test: 5,760 B/s, a delay of 100 ms each way, and each frame lost with
/// probability `loss`.
pub fn radio(loss: f64) -> Faults {
    let delay = Duration::from_millis(100);
    Faults { loss, delay_min: delay, delay_max: delay, bytes_per_s: Some(BYTES_PER_S), ..Faults::NONE }
}

/// Both ends of a line, and the frames on their way between the ends.
pub struct Air {
    /// Virtual time since the start.
    pub now: Duration,
    /// The state machines under test.
    pub ends: [Arq; 2],
    lines: [Line; 2],
    readers: [FrameReader; 2],
    arriving: [BTreeMap<(Duration, u64), Vec<u8>>; 2],
    frames: u64,
    /// All frames that are sent before this time are lost.
    pub cut_until: Duration,
    /// Number of frames that one end sent while the other end was still sending.
    pub collisions: u64,
    sending_until: [Duration; 2],
    /// The last turn that each end has sent, as a neighbour hears it.
    pub turns: [Turn; 2],
    /// For each end, the number after the highest piece that it has sent in its session.
    pub pieces: [u32; 2],
    /// A neighbour jams this piece of the first end in this session, so that it never arrives.
    pub jammed: Option<(u32, u32)>,
    /// Whether the owner of the second end takes no messages.
    pub is_busy: bool,
    /// Messages that have arrived at each end.
    pub received: [Vec<Vec<u8>>; 2],
    /// Events that each end has reported.
    pub events: [Vec<ArqEvent>; 2],
}

impl Air {
    /// Makes a line at time zero. The same seed gives the same faults.
    pub fn new(seed: u64, faults: Faults) -> Self {
        Self {
            now: Duration::ZERO,
            ends: [Arq::new(seed as u32 % 1000 + 1, BYTES_PER_S), Arq::new(5000, BYTES_PER_S)],
            lines: [Line::new(seed, faults), Line::new(seed ^ 0xA1, faults)],
            readers: Default::default(),
            arriving: Default::default(),
            frames: 0,
            cut_until: Duration::ZERO,
            collisions: 0,
            sending_until: [Duration::ZERO; 2],
            turns: Default::default(),
            pieces: [0; 2],
            jammed: None,
            is_busy: false,
            received: Default::default(),
            events: Default::default(),
        }
    }

    /// Simulates a restart of one end, which begins a new session.
    pub fn restart(&mut self, end: usize, session: u32) {
        self.ends[end] = Arq::new(session, BYTES_PER_S);
        self.readers[end] = FrameReader::default();
    }

    /// Delivers and sends the frames that are due, then advances the virtual time to the next event.
    pub fn step(&mut self) {
        for end in 0..2 {
            self.deliver(end);
            self.send(end);
            while let Some(event) = self.ends[end].next_event() {
                self.events[end].push(event);
            }
            while !(self.is_busy && end == 1)
                && let Some(message) = self.ends[end].next_message()
            {
                self.received[end].push(message);
            }
        }
        let arrivals = self.arriving.iter().filter_map(|line| line.keys().next()).map(|(at, _)| *at);
        let wakeups = self.ends.iter().map(Arq::next_wakeup);
        let next = arrivals.chain(wakeups).min().unwrap();
        self.now = next.clamp(self.now + Duration::from_micros(100), self.now + Duration::from_secs(1));
    }

    /// The session numbers that a frame from this end has, or that a neighbour writes into a forged one.
    pub fn sessions(&self, end: usize) -> Sessions {
        Sessions { sender: self.turns[end].sessions.sender, receiver: self.turns[1 - end].sessions.sender }
    }

    /// Lets a neighbour send a frame to one end, in the name of the other end or of somebody else. The frame
    /// arrives at once.
    pub fn forge(&mut self, end: usize, frame: &Frame<'_>, sessions: Sessions) {
        let mut out = [0; MAX_FRAME_BYTES];
        let bytes = frame.encode(sessions, &mut out).len();
        self.ends[end].on_frame(self.now, &mut out[..bytes - 1]);
    }

    /// Notes what a neighbour learns from a frame. Returns whether he jams the frame.
    fn overhear(&mut self, end: usize, mut frame: Vec<u8>) -> bool {
        frame.pop();
        match Frame::decode(&mut frame, self.sessions(end)) {
            Ok(Frame::Turn(turn)) => {
                if turn.sessions.sender != self.turns[end].sessions.sender {
                    self.pieces[end] = 0;
                }
                self.turns[end] = turn;
                false
            }
            Ok(Frame::Piece(piece)) => {
                self.pieces[end] = self.pieces[end].max(piece.number + 1);
                end == 0 && self.jammed == Some((self.turns[0].sessions.sender, piece.number))
            }
            Err(_) => false,
        }
    }

    fn deliver(&mut self, end: usize) {
        while let Some(first) = self.arriving[end].first_entry()
            && first.key().0 <= self.now
        {
            for byte in first.remove() {
                if let Some(frame) = self.readers[end].push(byte) {
                    self.ends[end].on_frame(self.now, frame);
                }
            }
        }
    }

    fn send(&mut self, end: usize) {
        let now = self.now;
        while let Some(frame) = self.ends[end].next_frame(now) {
            let frame = frame.to_vec();
            self.collisions += u64::from(self.sending_until[1 - end] > now);
            let arrivals = self.lines[end].carry(now, &frame);
            self.sending_until[end] = self.lines[end].free_at();
            let is_jammed = self.overhear(end, frame);
            for arrival in arrivals {
                if now >= self.cut_until && !is_jammed {
                    self.frames += 1;
                    self.arriving[1 - end].insert((arrival.at, self.frames), arrival.bytes);
                }
            }
        }
    }

    /// Sends `bytes` from the first end to the second, in messages of `message_bytes`. Each message begins with its
    /// number, a little-endian `u32`. Returns the time until the last message has arrived.
    pub fn send_all(&mut self, bytes: &[u8], message_bytes: usize) -> Duration {
        let mut messages = bytes.chunks(message_bytes).enumerate().peekable();
        let begun = self.now;
        let before = self.received[1].len();
        let total = messages.len();
        while self.received[1].len() < before + total {
            while self.ends[0].has_room()
                && let Some((i, message)) = messages.next()
            {
                // Without the numbers, `queue` would ignore a message that equals one still on its way.
                let mut numbered = (i as u32).to_le_bytes().to_vec();
                numbered.extend_from_slice(message);
                self.ends[0].queue(numbered);
            }
            self.step();
            assert!(self.now - begun < Duration::from_secs(4 * 3600), "it never arrives");
        }
        self.now - begun
    }
}

/// The faults of a radio, drawn from the bits of `seed`: every kind of fault except outages.
pub fn storm(seed: u64) -> Faults {
    let share = |shift: u32| (seed >> shift & 7) as f64 / 7.0;
    Faults {
        loss: 0.3 * share(0),
        duplication: 0.1 * share(3),
        corruption: 0.2 * share(6),
        truncation: 0.1 * share(9),
        delay_min: Duration::from_millis(seed % 150),
        delay_max: Duration::from_millis(seed % 150 + (seed >> 4) % 100),
        bytes_per_s: Some(BYTES_PER_S),
        outages: None::<Outages>,
    }
}

/// Test data in which a stretch of 200 bytes (one piece) repeats only after more than 10,000 bytes, so that a
/// misplaced piece is noticed.
pub fn pattern(count: usize) -> Vec<u8> {
    (0..count as u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect()
}

/// Joins messages that [`Air::send_all`] has sent, without their numbers.
pub fn joined(messages: &[Vec<u8>]) -> Vec<u8> {
    messages.iter().flat_map(|message| message[4..].to_vec()).collect()
}

/// Waits until the link is up, then sends `count` bytes over [`radio()`] in messages of 16,000 bytes. Returns the
/// bytes that arrived per second, divided by the line's bandwidth, and the number of collisions
/// ([`Air::collisions`]).
pub fn goodput(seed: u64, loss: f64, count: usize) -> (f64, u64) {
    let mut air = Air::new(seed, radio(loss));
    while air.events[0].is_empty() {
        air.step();
    }
    let sent = pattern(count);
    let time = air.send_all(&sent, 16_000);
    assert!(joined(&air.received[1]) == sent, "other bytes arrived");
    (count as f64 / time.as_secs_f64() / f64::from(BYTES_PER_S.get()), air.collisions)
}
