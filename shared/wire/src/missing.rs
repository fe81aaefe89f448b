//! Which chunks a receiver lacks, told in a bounded number of bytes.

use heapless::Vec;
use serde::{Deserialize, Serialize};

/// Bytes of the bitmap: 1024 chunks, 64 MiB of a body in chunks of 64 KiB. Ours: far beyond what is
/// ever in flight, and small beside one chunk.
pub const MISSING_BITMAP_BYTES: usize = 128;

/// What a receiver has and lacks. Chunks below `first` are here; those in the window of the bitmap
/// are missing where their bit is set; those from `rest_from` on are missing; of any between, nothing
/// is said.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Missing {
    first: u32,
    bitmap: Vec<u8, MISSING_BITMAP_BYTES>,
    rest_from: u32,
}

/// What a [`Missing`] says of one chunk.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Knowledge {
    /// The receiver has it.
    Here,
    /// The receiver lacks it.
    Missing,
    /// It is outside the window.
    Unsaid,
}

impl Missing {
    /// Everything is missing.
    pub fn all() -> Self {
        Self { first: 0, bitmap: Vec::new(), rest_from: 0 }
    }

    /// Describes `count` chunks of which `here(index)` have arrived: the window starts at the first
    /// that has not.
    pub fn of(count: u32, here: impl Fn(u32) -> bool) -> Self {
        let first = (0..count).find(|&i| !here(i)).unwrap_or(count);
        let rest_from = (first..count).rev().find(|&i| here(i)).map_or(first, |i| i + 1);
        let window = (rest_from - first).min(8 * MISSING_BITMAP_BYTES as u32);
        let mut bitmap = Vec::new();
        for start in (first..first + window).step_by(8) {
            let byte = (0..8).filter(|bit| start + bit < rest_from && !here(start + bit));
            // The window is no longer than the bitmap, so there is room.
            let _ = bitmap.push(byte.fold(0, |byte, bit| byte | 1 << bit));
        }
        Self { first, bitmap, rest_from }
    }

    /// What is said of chunk `index`.
    pub fn of_chunk(&self, index: u32) -> Knowledge {
        if index >= self.rest_from {
            return Knowledge::Missing;
        }
        if index < self.first {
            return Knowledge::Here;
        }
        let offset = index - self.first;
        match self.bitmap.get(offset as usize / 8) {
            Some(byte) if byte >> (offset % 8) & 1 == 1 => Knowledge::Missing,
            Some(_) => Knowledge::Here,
            None => Knowledge::Unsaid,
        }
    }
}
