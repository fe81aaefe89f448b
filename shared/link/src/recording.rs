//! What was said on a broker, as a file: one entry for each message, in the order in which they came.
//!
//! The file begins with [`MAGIC`]. An entry is, little-endian: microseconds since the one before (`u32`),
//! flags (`u8`: bit 0 retained, bits 1 and 2 the QoS), bytes of the topic (`u16`), bytes of the payload
//! (`u32`), topic, payload, CRC-32 of all that (`u32`). A recording that was cut off by a kill or a power
//! cut ends with its last whole entry.

use std::io::{self, Read, Write};
use std::time::Duration;

use cosurf_wire::{MAX_MESSAGE_BYTES, MAX_TOPIC_BYTES};

/// First bytes of a recording; the last is the version.
pub const MAGIC: [u8; 8] = *b"cosurfR\x01";
/// Largest topic and payload that are recorded: ours, with room for the messages of others.
const TOPIC_BYTES_MAX: usize = 4 * MAX_TOPIC_BYTES;
const PAYLOAD_BYTES_MAX: usize = 4 * MAX_MESSAGE_BYTES;
const HEAD_BYTES: usize = 4 + 1 + 2 + 4;

/// One message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Entry {
    /// Since the recording began.
    pub at: Duration,
    /// Under which topic.
    pub topic: String,
    /// 0 or 1.
    pub qos: u8,
    /// Whether it was published to be retained.
    pub retain: bool,
    /// Its bytes.
    pub payload: Vec<u8>,
}

/// Why a recording cannot be read on.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RecordingError {
    /// The file cannot be read.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// It is something else.
    #[error("not a recording of this version: `cosurf-aggregator record` makes them")]
    NotARecording,
    /// An entry contradicts itself.
    #[error("entry {0} is damaged; what comes before it is whole")]
    Damaged(u64),
}

/// Writes a recording.
#[derive(Debug)]
pub struct Recorder<W> {
    out: W,
    last_us: u64,
}

impl<W: Write> Recorder<W> {
    /// Begins.
    pub fn new(mut out: W) -> io::Result<Self> {
        out.write_all(&MAGIC)?;
        Ok(Self { out, last_us: 0 })
    }

    /// Adds one message; returns `false` where it is larger than any that is recorded.
    pub fn add(&mut self, entry: &Entry) -> io::Result<bool> {
        let Entry { at, topic, qos, retain, payload } = entry;
        if topic.len() > TOPIC_BYTES_MAX || payload.len() > PAYLOAD_BYTES_MAX {
            return Ok(false);
        }
        let at_us = at.as_micros() as u64;
        // A pause of more than 71 minutes is shortened to that.
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

    /// Hands everything to the operating system.
    pub fn flush(&mut self) -> io::Result<()> {
        self.out.flush()
    }
}

/// Reads a recording, entry by entry.
#[derive(Debug)]
pub struct Recording<R> {
    input: R,
    at: Duration,
    entries: u64,
}

impl<R: Read> Recording<R> {
    /// Opens it.
    pub fn open(mut input: R) -> Result<Self, RecordingError> {
        let mut magic = [0; MAGIC.len()];
        input.read_exact(&mut magic).map_err(|_| RecordingError::NotARecording)?;
        if magic != MAGIC {
            return Err(RecordingError::NotARecording);
        }
        Ok(Self { input, at: Duration::ZERO, entries: 0 })
    }

    /// The next message; `None` at the end, also where the last entry was cut off.
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

/// Fills the buffer; `false` where the input ends before.
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

    /// The entries that can be read, and whether the end was clean.
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
    fn a_recording_comes_back() {
        assert_eq!(read(&recorded()), (entries(), true));
    }

    #[test]
    fn one_cut_off_ends_with_its_last_whole_entry() {
        let bytes = recorded();
        for end in (0..bytes.len()).step_by(13) {
            let (found, _) = read(&bytes[..end]);
            assert_eq!(found, entries()[..found.len()], "cut at {end}");
        }
    }

    #[test]
    fn damage_is_noticed_and_takes_no_memory() {
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
    fn what_is_too_large_is_left_out() {
        let mut recorder = Recorder::new(Vec::new()).unwrap();
        let mut entry = entries().remove(0);
        entry.payload = vec![0; PAYLOAD_BYTES_MAX + 1];
        assert!(!recorder.add(&entry).unwrap());
    }
}
