//! The sources of a cache: picture files, and the sizes to which they are shrunk.

use std::path::PathBuf;

use crate::picture::bytes_of;
use crate::{Mask, Shrinking, View};

/// A picture to cache: its file, and the size to shrink it to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Source {
    /// The picture's file.
    pub path: PathBuf,
    /// The picture's mask, if it has one.
    pub mask: Option<Mask>,
    /// Width and height after shrinking.
    pub size_px: [u32; 2],
    /// When the picture is shrunk.
    pub shrinking: Shrinking,
}

impl Source {
    /// The picture of `view`, shrunk until its long side is at most `long_side_px`.
    pub fn of(view: &View, long_side_px: u32, shrinking: Shrinking) -> Self {
        Self {
            path: view.path.clone(),
            mask: view.mask.clone(),
            size_px: view.camera.fitted_size(long_side_px),
            shrinking,
        }
    }
}

/// Bytes of the largest picture, uncompressed.
pub(super) fn largest_bytes(sources: &[Source]) -> u64 {
    sources.iter().map(|source| bytes_of(source.size_px)).max().unwrap_or(0)
}

/// Bytes of all pictures together, uncompressed.
pub(super) fn total_bytes(sources: &[Source]) -> u64 {
    sources.iter().map(|source| bytes_of(source.size_px)).sum()
}
