//! Opens models to render them within the memory of a merge.
//!
//! What it knows nothing about: what the pictures are for.

use std::path::PathBuf;

use cosurf_contract::usage;
use cosurf_engine::{Place, ViewMemory, Views};
use cosurf_scene::{LocalFrame, SceneError};

/// Bytes per pixel of what is made of a picture: a photograph, its values, the true surface, pictures of errors.
const MADE_BYTES_PER_PIXEL: u64 = 48;

/// The model in the PLY file `path`, moved into `frame`, to be rendered by a process of at most `limit_bytes`.
pub(crate) fn open_within(
    path: PathBuf,
    frame: &LocalFrame,
    limit_bytes: u64,
    threads: usize,
) -> Result<Views, SceneError> {
    let memory = ViewMemory {
        limit_bytes,
        held_bytes: usage::held_bytes,
        made_bytes: 0,
        made_bytes_per_pixel: MADE_BYTES_PER_PIXEL,
    };
    Views::open(path, frame, Place::Within(memory), threads)
}
