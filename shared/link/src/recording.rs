//! Recordings of a broker's messages as files: one entry per message, in order of arrival.
//!
//! The file begins with [`MAGIC`]. An entry contains, little-endian: microseconds since the previous entry
//! (`u32`), flags (`u8`: bit 0 is the retain flag, bits 1 and 2 are the QoS), size of the topic (`u16`), size
//! of the payload (`u32`), topic, payload, CRC-32 of these bytes (`u32`). Bytes that are no whole entry are passed over, as
//! far as the next place at which one begins: a damaged disk costs the entries that it damaged, and a kill or a power cut
//! the last one. So do the bytes of a damaged beginning. [`Recording::lost`] tells how many bytes were passed over.

use std::io::{self, Read, Write};
use std::time::Duration;

use cosurf_wire::{MAX_MESSAGE_BYTES, MAX_TOPIC_BYTES};

/// First bytes of a recording. The last of them is the version of the format.
pub const MAGIC: [u8; 8] = *b"cosurfR\x01";
/// Largest topic that is recorded, in bytes: four times that of this protocol, so that other messages on the
/// broker fit too.
const TOPIC_BYTES_MAX: usize = 4 * MAX_TOPIC_BYTES;
/// Largest payload that is recorded, in bytes: four times that of this protocol, so that other messages on
/// the broker fit too.
const PAYLOAD_BYTES_MAX: usize = 4 * MAX_MESSAGE_BYTES;
const HEAD_BYTES: usize = 4 + 1 + 2 + 4;
const CHECKSUM_BYTES: usize = 4;
/// Number of bytes that are read at once, at least.
const READ_AHEAD_BYTES: usize = 1 << 16;

/// A recorded message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Entry {
    /// Time since the start of the recording.
    pub at: Duration,
    /// The message's topic.
    pub topic: String,
    /// The MQTT quality of service of the delivery: 0 or 1.
    pub qos: u8,
    /// Whether the message was published with the retain flag.
    pub retain: bool,
    /// The message's bytes.
    pub payload: Vec<u8>,
}

/// Why a recording cannot be read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RecordingError {
    /// The file cannot be read.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// There is nothing in the file.
    #[error("is empty (0 bytes): nothing was recorded, or the file was cut; fetch it again")]
    Empty,
    /// The file neither begins like a recording of this format version, nor holds an entry of one.
    #[error("not a recording of this version: make one with `cosurf-aggregator record`")]
    NotARecording,
}

/// Writes a recording.
#[derive(Debug)]
pub struct Recorder<W> {
    out: W,
    last_us: u64,
}

impl<W: Write> Recorder<W> {
    /// Starts a recording.
    pub fn new(mut out: W) -> io::Result<Self> {
        out.write_all(&MAGIC)?;
        Ok(Self { out, last_us: 0 })
    }

    /// Adds a message. If the message is too large, skips it and returns `false`.
    pub fn add(&mut self, entry: &Entry) -> io::Result<bool> {
        let Entry { at, topic, qos, retain, payload } = entry;
        if topic.len() > TOPIC_BYTES_MAX || payload.len() > PAYLOAD_BYTES_MAX {
            return Ok(false);
        }
        let at_us = at.as_micros() as u64;
        // A pause longer than 71 minutes is shortened to that, the longest that a `u32` of microseconds
        // holds.
        let pause_us = u32::try_from(at_us.saturating_sub(self.last_us)).unwrap_or(u32::MAX);
        self.last_us = self.last_us.max(at_us);
        let mut bytes = Vec::with_capacity(HEAD_BYTES + topic.len() + payload.len() + 4);
        bytes.extend_from_slice(&pause_us.to_le_bytes());
        bytes.push(u8::from(*retain) | qos << 1);
        bytes.extend_from_slice(&(topic.len() as u16).to_le_bytes());
        bytes.extend_from_slice(&(payload.len() as u32).to_le_bytes());
        bytes.extend_from_slice(topic.as_bytes());
        bytes.extend_from_slice(payload);
        let checksum = crc32fast::hash(&bytes);
        bytes.extend_from_slice(&checksum.to_le_bytes());
        self.out.write_all(&bytes)?;
        Ok(true)
    }

    /// Flushes the writer.
    pub fn flush(&mut self) -> io::Result<()> {
        self.out.flush()
    }
}

/// What was passed over because it is damaged or cut off.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Lost {
    /// Number of places, each between two whole entries or at the end.
    pub places: u64,
    /// Number of bytes at all of these places.
    pub bytes: u64,
}

/// Reads a recording entry by entry.
#[derive(Debug)]
pub struct Recording<R> {
    input: R,
    at: Duration,
    /// Bytes that were read ahead; those before `begin` are used up.
    ahead: Vec<u8>,
    begin: usize,
    lost: Lost,
    /// The first entry, if it was looked for behind a damaged beginning.
    first: Option<Entry>,
    /// Whether the bytes just before `begin` were passed over.
    is_passing_over: bool,
}

impl<R: Read> Recording<R> {
    /// Opens a recording. If its beginning is damaged, reads up to the first entry.
    pub fn open(input: R) -> Result<Self, RecordingError> {
        let mut recording = Self {
            input,
            at: Duration::ZERO,
            ahead: Vec::new(),
            begin: 0,
            lost: Lost::default(),
            first: None,
            is_passing_over: false,
        };
        if recording.fill(MAGIC.len())? == 0 {
            return Err(RecordingError::Empty);
        }
        if recording.ahead.starts_with(&MAGIC) {
            recording.begin = MAGIC.len();
            return Ok(recording);
        }
        recording.first = recording.next_entry()?;
        if recording.first.is_some() { Ok(recording) } else { Err(RecordingError::NotARecording) }
    }

    /// What was passed over so far.
    pub fn lost(&self) -> Lost {
        self.lost
    }

    /// Returns the next message; `None` at the end of the recording.
    pub fn next_entry(&mut self) -> Result<Option<Entry>, RecordingError> {
        if let Some(first) = self.first.take() {
            return Ok(Some(first));
        }
        while self.fill(1)? >= 1 {
            if let Some((entry, pause, bytes)) = self.entry()? {
                self.begin += bytes;
                self.at += pause;
                self.is_passing_over = false;
                return Ok(Some(Entry { at: self.at, ..entry }));
            }
            self.lost.places += u64::from(!self.is_passing_over);
            self.lost.bytes += 1;
            self.begin += 1;
            self.is_passing_over = true;
        }
        Ok(None)
    }

    /// The entry that begins at `begin`, the pause before it, and its size in bytes; `None` if none does.
    fn entry(&mut self) -> Result<Option<(Entry, Duration, usize)>, RecordingError> {
        if self.fill(HEAD_BYTES)? < HEAD_BYTES {
            return Ok(None);
        }
        let Some(&[a, b, c, d, flags, e, f, g, h, i, j]) = self.ahead[self.begin..].first_chunk() else {
            return Ok(None);
        };
        let (topic_bytes, payload_bytes) =
            (usize::from(u16::from_le_bytes([e, f])), u32::from_le_bytes([g, h, i, j]) as usize);
        if topic_bytes > TOPIC_BYTES_MAX || payload_bytes > PAYLOAD_BYTES_MAX || flags > 0b101 {
            return Ok(None);
        }
        let bytes = HEAD_BYTES + topic_bytes + payload_bytes + CHECKSUM_BYTES;
        if self.fill(bytes)? < bytes {
            return Ok(None);
        }
        let whole = &self.ahead[self.begin..self.begin + bytes];
        let (content, checksum) = whole.split_at(bytes - CHECKSUM_BYTES);
        if crc32fast::hash(content).to_le_bytes() != *checksum {
            return Ok(None);
        }
        let (topic, payload) = content[HEAD_BYTES..].split_at(topic_bytes);
        let Ok(topic) = std::str::from_utf8(topic) else { return Ok(None) };
        let pause = Duration::from_micros(u64::from(u32::from_le_bytes([a, b, c, d])));
        let (topic, payload) = (topic.to_owned(), payload.to_vec());
        let entry = Entry { at: self.at, topic, qos: flags >> 1, retain: flags & 1 == 1, payload };
        Ok(Some((entry, pause, bytes)))
    }

    /// Reads ahead until `bytes` are there, or the input ends. Returns how many are there.
    fn fill(&mut self, bytes: usize) -> io::Result<usize> {
        let there = self.ahead.len() - self.begin;
        if there >= bytes {
            return Ok(there);
        }
        self.ahead.drain(..self.begin);
        self.begin = 0;
        let wanted = bytes.max(READ_AHEAD_BYTES) - there;
        self.input.by_ref().take(wanted as u64).read_to_end(&mut self.ahead)?;
        Ok(self.ahead.len())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::faults::Dice;

    fn entries() -> Vec<Entry> {
        let entry = |i: u64| Entry {
            at: Duration::from_micros(i * i * 1000),
            topic: format!("gs/v1/site/drone/up/1/c/{i}"),
            qos: (i % 2) as u8,
            retain: i.is_multiple_of(3),
            payload: vec![i as u8; (i * 37) as usize],
        };
        (0..50).map(entry).collect()
    }

    fn recorded() -> Vec<u8> {
        let mut bytes = Vec::new();
        let mut recorder = Recorder::new(&mut bytes).unwrap();
        entries().iter().for_each(|entry| assert!(recorder.add(entry).unwrap()));
        bytes
    }

    /// The readable entries, and what was passed over; `None` if this is no recording.
    fn read(bytes: &[u8]) -> Option<(Vec<Entry>, Lost)> {
        let mut recording = Recording::open(bytes).ok()?;
        let mut found = Vec::new();
        while let Some(entry) = recording.next_entry().unwrap() {
            found.push(entry);
        }
        Some((found, recording.lost()))
    }

    /// Where each entry begins, and the end of the last one.
    fn begins() -> Vec<usize> {
        let bytes = |entry: &Entry| HEAD_BYTES + entry.topic.len() + entry.payload.len() + CHECKSUM_BYTES;
        let mut begins = vec![MAGIC.len()];
        entries().iter().for_each(|entry| begins.push(begins.last().unwrap() + bytes(entry)));
        begins
    }

    #[test]
    fn a_recording_round_trips() {
        assert_eq!(read(&recorded()), Some((entries(), Lost::default())));
    }

    #[test]
    fn a_truncated_recording_ends_with_its_last_whole_entry_and_the_cut_is_told() {
        let (bytes, begins) = (recorded(), begins());
        for end in (MAGIC.len()..bytes.len()).step_by(13) {
            let (found, lost) = read(&bytes[..end]).unwrap();
            let whole = begins.iter().filter(|begin| **begin <= end).count() - 1;
            let cut = (end - begins[whole]) as u64;
            assert_eq!(found, entries()[..whole], "cut at {end}");
            assert_eq!(lost, Lost { places: u64::from(cut > 0), bytes: cut }, "cut at {end}");
        }
    }

    #[test]
    fn a_damaged_entry_costs_no_other() {
        let (bytes, begins, mut dice) = (recorded(), begins(), Dice::new(1));
        for _ in 0..2000 {
            let mut changed = bytes.clone();
            let place = dice.below(changed.len() as u64) as usize;
            changed[place] ^= 1 << dice.below(8);
            let (found, lost) = read(&changed).unwrap();
            if place < MAGIC.len() {
                let head = Lost { places: 1, bytes: MAGIC.len() as u64 };
                assert_eq!((found, lost), (entries(), head), "byte {place}");
                continue;
            }
            let damaged = begins.iter().filter(|begin| **begin <= place).count() - 1;
            let mut expected = entries();
            // The pause before a damaged entry is not known.
            let pause =
                expected[damaged].at - damaged.checked_sub(1).map_or(Duration::ZERO, |i| expected[i].at);
            expected.remove(damaged);
            expected[damaged..].iter_mut().for_each(|entry| entry.at -= pause);
            assert_eq!(found, expected, "byte {place}");
            assert_eq!(lost, Lost { places: 1, bytes: (begins[damaged + 1] - begins[damaged]) as u64 });
        }
    }

    #[test]
    fn what_holds_no_entry_is_no_recording() {
        let open = |bytes: &[u8]| Recording::open(bytes).map(drop);
        assert!(matches!(open(b""), Err(RecordingError::Empty)));
        for other in [&b"cosurf"[..], b"cosurfR\x02", &[0; 5000], &[0xFF; 5000]] {
            assert!(matches!(open(other), Err(RecordingError::NotARecording)), "{other:?}");
        }
        assert_eq!(read(&MAGIC), Some((Vec::new(), Lost::default())), "nothing was recorded yet");
    }

    #[test]
    fn a_message_that_is_too_large_is_skipped() {
        let mut recorder = Recorder::new(Vec::new()).unwrap();
        let mut entry = entries().remove(0);
        entry.payload = vec![0; PAYLOAD_BYTES_MAX + 1];
        assert!(!recorder.add(&entry).unwrap());
    }
}
