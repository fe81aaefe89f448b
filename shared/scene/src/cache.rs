//! The training pictures at training size, within a byte budget: decoded once, shrunk once, kept
//! raw where they all fit, else compressed, else read again from disk.

use std::path::PathBuf;
use std::sync::Arc;

use crate::{Picture, SceneError};

/// A picture to keep ready: where it lies and the size it is wanted at.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Source {
    /// The file.
    pub path: PathBuf,
    /// Width and height wanted.
    pub size_px: [u32; 2],
}

/// A byte-bounded cache of pictures; see the module. Shared by reference between threads.
pub struct PictureCache {
    sources: Vec<Source>,
}

impl PictureCache {
    /// A cache over `sources` that holds at most `budget_bytes` of pictures, those handed out and
    /// those decoded ahead included. Reads no picture yet, only headers. A budget below
    /// [`Self::least_bytes`] is an error that says so.
    pub fn new(sources: Vec<Source>, budget_bytes: u64) -> Result<Self, SceneError> {
        let _ = budget_bytes;
        Ok(Self { sources })
    }

    /// The smallest budget that works: two pictures of the largest size.
    pub fn least_bytes(sources: &[Source]) -> u64 {
        let _ = sources;
        unimplemented!("lands next")
    }

    /// The budget at which nothing is compressed: all pictures raw.
    pub fn most_bytes(sources: &[Source]) -> u64 {
        let _ = sources;
        unimplemented!("lands next")
    }

    /// Bytes that decoding and shrinking the most demanding source needs beside the budget, while
    /// it lasts; at most one picture is decoded at a time.
    pub fn scratch_bytes(sources: &[Source]) -> Result<u64, SceneError> {
        let _ = sources;
        unimplemented!("lands next")
    }

    /// Picture `index` at its wanted size; the same bytes whatever was cached. Hold at most two.
    pub fn get(&self, index: usize) -> Result<Arc<Picture>, SceneError> {
        let _ = (index, &self.sources);
        unimplemented!("lands next")
    }

    /// Asks the background thread to have picture `index` ready soon. Never blocks, may be ignored.
    pub fn prefetch(&self, index: usize) {
        let _ = index;
        unimplemented!("lands next")
    }

    /// Bytes of pictures held now, in whatever form; never above the budget.
    pub fn used_bytes(&self) -> u64 {
        unimplemented!("lands next")
    }
}
