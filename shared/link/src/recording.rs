//! Recordings of a broker's messages as files: one entry per message, in order of arrival.
//!
//! The file begins with [`MAGIC`]. An entry contains, little-endian: microseconds since the previous entry
//! (`u32`), flags (`u8`: bit 0 is the retain flag, bits 1 and 2 are the QoS), size of the topic (`u16`), size
//! of the payload (`u32`), topic, payload, CRC-32 of these bytes (`u32`). If a kill or a power cut has
//! truncated a recording, reading ends after the last whole entry.

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
    /// The file is not a recording, or it has another format version.
    #[error("not a recording of this version: make one with `cosurf-aggregator record`")]
    NotARecording,
    /// An entry is damaged.
    #[error("entry {0} is damaged; the entries before it are intact")]
    Damaged(u64),
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

/// Reads a recording entry by entry.
#[derive(Debug)]
pub struct Recording<R> {
    input: R,
    at: Duration,
    entries: u64,
}

impl<R: Read> Recording<R> {
    /// Opens a recording.
    pub fn open(mut input: R) -> Result<Self, RecordingError> {
        let mut magic = [0; MAGIC.len()];
        input.read_exact(&mut magic).map_err(|_| RecordingError::NotARecording)?;
        if magic != MAGIC {
            return Err(RecordingError::NotARecording);
        }
        Ok(Self { input, at: Duration::ZERO, entries: 0 })
    }

    /// Returns the next message; `None` at the end of the recording, or if the last entry is truncated.
    pub fn next_entry(&mut self) -> Result<Option<Entry>, RecordingError> {
        let mut head = [0; HEAD_BYTES];
        if !read_whole(&mut self.input, &mut head)? {
            return Ok(None);
        }
        let [a, b, c, d, flags, e, f, g, h, i, j] = head;
        let (topic_bytes, payload_bytes) =
            (usize::from(u16::from_le_bytes([e, f])), u32::from_le_bytes([g, h, i, j]) as usize);
        let damaged = RecordingError::Damaged(self.entries);
        if topic_bytes > TOPIC_BYTES_MAX || payload_bytes > PAYLOAD_BYTES_MAX || flags > 0b101 {
            return Err(damaged);
        }
        let mut rest = vec![0; topic_bytes + payload_bytes + 4];
        if !read_whole(&mut self.input, &mut rest)? {
            return Ok(None);
        }
        let checksum = rest.split_off(topic_bytes + payload_bytes);
        let mut hasher = crc32fast::Hasher::new();
        hasher.update(&head);
        hasher.update(&rest);
        if hasher.finalize().to_le_bytes() != checksum[..] {
            return Err(damaged);
        }
        let payload = rest.split_off(topic_bytes);
        let topic = String::from_utf8(rest).map_err(|_| damaged)?;
        self.at += Duration::from_micros(u64::from(u32::from_le_bytes([a, b, c, d])));
        self.entries += 1;
        Ok(Some(Entry { at: self.at, topic, qos: flags >> 1, retain: flags & 1 == 1, payload }))
    }
}

/// Fills the buffer. Returns `false` if the input ends before the buffer is full.
fn read_whole(input: &mut impl Read, buffer: &mut [u8]) -> io::Result<bool> {
    match input.read_exact(buffer) {
        Ok(()) => Ok(true),
        Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => Ok(false),
        Err(error) => Err(error),
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

    /// The readable entries, and whether the recording ended without an error.
    fn read(bytes: &[u8]) -> (Vec<Entry>, bool) {
        let Ok(mut recording) = Recording::open(bytes) else { return (Vec::new(), false) };
        let mut found = Vec::new();
        loop {
            match recording.next_entry() {
                Ok(Some(entry)) => found.push(entry),
                Ok(None) => return (found, true),
                Err(_) => return (found, false),
            }
        }
    }

    #[test]
    fn a_recording_round_trips() {
        assert_eq!(read(&recorded()), (entries(), true));
    }

    #[test]
    fn a_truncated_recording_ends_with_its_last_whole_entry() {
        let bytes = recorded();
        for end in (0..bytes.len()).step_by(13) {
            let (found, _) = read(&bytes[..end]);
            assert_eq!(found, entries()[..found.len()], "cut at {end}");
        }
    }

    #[test]
    fn a_recording_ends_before_a_damaged_entry() {
        let (bytes, mut dice) = (recorded(), Dice::new(1));
        for _ in 0..2000 {
            let mut changed = bytes.clone();
            let place = dice.below(changed.len() as u64) as usize;
            changed[place] ^= 1 << dice.below(8);
            let (found, _) = read(&changed);
            assert!(found.len() < 50 && found == entries()[..found.len()], "byte {place}");
        }
    }

    #[test]
    fn a_message_that_is_too_large_is_skipped() {
        let mut recorder = Recorder::new(Vec::new()).unwrap();
        let mut entry = entries().remove(0);
        entry.payload = vec![0; PAYLOAD_BYTES_MAX + 1];
        assert!(!recorder.add(&entry).unwrap());
    }
}
