//! Which chunks a receiver lacks, encoded in a bounded number of bytes.

use heapless::Vec;
use serde::{Deserialize, Serialize};

/// Largest size of the bitmap in bytes. The bitmap then covers 1024 chunks, far more than a sender has in
/// flight, and is still far smaller than one chunk of 64 KiB.
pub const MISSING_BITMAP_BYTES: usize = 128;

/// The chunks that a receiver has and lacks. The receiver has all chunks below `first`, and lacks all
/// chunks from `rest_from` on. The bitmap describes the chunks from `first` on: a set bit marks a missing
/// chunk. If the bitmap ends before `rest_from`, it does not describe the chunks in between.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Missing {
    first: u32,
    bitmap: Vec<u8, MISSING_BITMAP_BYTES>,
    rest_from: u32,
}

/// The state of one chunk according to a [`Missing`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ChunkStatus {
    /// The receiver has the chunk.
    Received,
    /// The receiver lacks the chunk.
    Missing,
    /// The chunk is beyond the bitmap: the receiver may have or lack it.
    Unknown,
}

impl Missing {
    /// All chunks are missing.
    pub fn all() -> Self {
        Self { first: 0, bitmap: Vec::new(), rest_from: 0 }
    }

    /// Describes `count` chunks. `here` tells whether the chunk with a given index has arrived. The bitmap
    /// starts at the first missing chunk.
    pub fn of(count: u32, here: impl Fn(u32) -> bool) -> Self {
        let first = (0..count).find(|&i| !here(i)).unwrap_or(count);
        let rest_from = (first..count).rev().find(|&i| here(i)).map_or(first, |i| i + 1);
        let window = (rest_from - first).min(8 * MISSING_BITMAP_BYTES as u32);
        let mut bitmap = Vec::new();
        for start in (first..first + window).step_by(8) {
            let byte = (0..8).filter(|bit| start + bit < rest_from && !here(start + bit));
            // `window` has at most as many bits as the bitmap, so the push succeeds.
            let _ = bitmap.push(byte.fold(0, |byte, bit| byte | 1 << bit));
        }
        Self { first, bitmap, rest_from }
    }

    /// The state of chunk `index`.
    pub fn status_of(&self, index: u32) -> ChunkStatus {
        if index >= self.rest_from {
            return ChunkStatus::Missing;
        }
        if index < self.first {
            return ChunkStatus::Received;
        }
        let offset = index - self.first;
        match self.bitmap.get(offset as usize / 8) {
            Some(byte) if byte >> (offset % 8) & 1 == 1 => ChunkStatus::Missing,
            Some(_) => ChunkStatus::Received,
            None => ChunkStatus::Unknown,
        }
    }
}
