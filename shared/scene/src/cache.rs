//! The training pictures at training size, within a byte budget: decoded once, shrunk once, then
//! kept raw where all of them fit, else compressed (`pack`), else read again from disk.
//!
//! What is compressed stays, unless callers hold more than two pictures: with more pictures than fit, throwing the oldest out for the newest
//! would in an epoch of training throw out each just before it is wanted again.
//!
//! An eighth of the budget, and at least two pictures, is for copies: those handed out, those made
//! ahead and the one being made. The rest is for what is kept.
//!
//! One picture at a time is decoded, by whoever wants it: the caller of [`PictureCache::get`] or the
//! thread that [`PictureCache::prefetch`] keeps busy. So the memory that decoding takes is known
//! beforehand ([`PictureCache::scratch_bytes`]). Every form holds the same pixels, so nothing that is
//! computed from a picture depends on timing or budget.

mod pack;
mod state;
#[cfg(test)]
mod tests;

use std::path::PathBuf;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};

use crate::picture::bytes_of;
use crate::{Picture, SceneError, View};
use state::{Slot, State};

/// A picture to keep ready: where it lies and the size it is wanted at.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Source {
    /// The file.
    pub path: PathBuf,
    /// Width and height wanted.
    pub size_px: [u32; 2],
}

impl Source {
    /// The picture of `view`, shrunk until its long side is at most `long_side_px`.
    pub fn of(view: &View, long_side_px: u32) -> Self {
        Self { path: view.path.clone(), size_px: view.camera.fitted_size(long_side_px) }
    }
}

/// What a cache holds now.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CacheUse {
    /// Bytes of pictures in whatever form, those handed out and being made included; never above
    /// the budget.
    pub used_bytes: u64,
    /// Pictures kept raw.
    pub raw: usize,
    /// Pictures kept compressed.
    pub packed: usize,
    /// Pictures read again from disk whenever they are wanted.
    pub on_disk: usize,
    /// How often a file was decoded.
    pub decoded: u64,
}

/// A byte-bounded cache of pictures; see the module. Shared by reference between threads.
pub struct PictureCache {
    shared: Arc<Shared>,
    prefetcher: Option<JoinHandle<()>>,
}

struct Shared {
    sources: Vec<Source>,
    state: Mutex<State>,
    /// Something in the state changed that another thread may wait for.
    changed: Condvar,
}

impl PictureCache {
    /// A cache over `sources` that holds at most `budget_bytes` of pictures, those handed out and
    /// those decoded ahead included. Reads nothing yet. A budget below [`Self::least_bytes`] is an
    /// error that says so.
    pub fn new(sources: Vec<Source>, budget_bytes: u64) -> Result<Self, SceneError> {
        let needed_bytes = Self::least_bytes(&sources);
        if budget_bytes < needed_bytes {
            return Err(SceneError::OverBudget { needed_bytes, budget_bytes });
        }
        let state = Mutex::new(State::new(&sources, budget_bytes));
        let shared = Arc::new(Shared { sources, state, changed: Condvar::new() });
        let for_thread = Arc::clone(&shared);
        let prefetcher =
            thread::Builder::new().name("pictures".into()).spawn(move || for_thread.prefetch_all());
        // Without the thread pictures are decoded when they are wanted.
        Ok(Self { shared, prefetcher: prefetcher.ok() })
    }

    /// The smallest budget that works: two pictures of the largest size, one in use and one being
    /// made, or all pictures if that is less.
    pub fn least_bytes(sources: &[Source]) -> u64 {
        (2 * largest_bytes(sources)).min(Self::most_bytes(sources))
    }

    /// The budget at which nothing is compressed: all pictures raw.
    pub fn most_bytes(sources: &[Source]) -> u64 {
        sources.iter().map(|source| bytes_of(source.size_px)).sum()
    }

    /// Bytes that decoding, shrinking and compressing the most demanding source needs beside the
    /// budget, while it lasts. Reads every header.
    pub fn scratch_bytes(sources: &[Source]) -> Result<u64, SceneError> {
        let mut most = pack::scratch_bytes(largest_bytes(sources));
        for source in sources {
            most = most.max(Picture::scratch_bytes(&source.path, source.size_px)?);
        }
        Ok(most)
    }

    /// Picture `index` at its wanted size; the same pixels whatever was cached. What is handed out
    /// counts until it is dropped, and getting another for which the budget then has no room is an
    /// error; the least budget has room for one while another is held.
    pub fn get(&self, index: usize) -> Result<Arc<Picture>, SceneError> {
        let shared = &self.shared;
        let mut state = shared.lock();
        // The prefetcher may wait for what the caller dropped since.
        shared.changed.notify_all();
        loop {
            if let Some(picture) = state.take(index) {
                return Ok(picture);
            }
            if !state.is_making() {
                break;
            }
            state = shared.wait(state);
        }
        state.make_room(index)?;
        shared.make(state, index, false)
    }

    /// Asks the background thread to have picture `index` ready soon. Never blocks; passed over
    /// where too much was asked already.
    pub fn prefetch(&self, index: usize) {
        self.shared.lock().order(index);
        self.shared.changed.notify_all();
    }

    /// What it holds now.
    pub fn usage(&self) -> CacheUse {
        self.shared.lock().usage()
    }
}

impl Drop for PictureCache {
    fn drop(&mut self) {
        self.shared.lock().close();
        self.shared.changed.notify_all();
        if let Some(prefetcher) = self.prefetcher.take() {
            // Had it panicked, its message was printed, and pictures came without it.
            let _ = prefetcher.join();
        }
    }
}

fn largest_bytes(sources: &[Source]) -> u64 {
    sources.iter().map(|source| bytes_of(source.size_px)).max().unwrap_or(0)
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wait<'a>(&self, state: MutexGuard<'a, State>) -> MutexGuard<'a, State> {
        self.changed.wait(state).unwrap_or_else(PoisonError::into_inner)
    }

    /// The background thread: makes what was ordered, as room allows.
    fn prefetch_all(&self) {
        let mut state = self.lock();
        while !state.is_closed() {
            match state.next_order() {
                Some(index) => {
                    // An error comes again, to the caller, when the picture is wanted.
                    let _ = self.make(state, index, true);
                    state = self.lock();
                }
                None => state = self.wait(state),
            }
        }
    }

    /// Makes picture `index` from its compressed form or its file, without holding the lock
    /// meanwhile, to be held ready if it is made `ahead`. There must be room, and nothing else being
    /// made.
    fn make(
        &self,
        mut state: MutexGuard<'_, State>,
        index: usize,
        ahead: bool,
    ) -> Result<Arc<Picture>, SceneError> {
        let from = state.begin(index);
        drop(state);
        let _making = Making { shared: self, index };
        let Source { path, size_px } = &self.sources[index];
        let (picture, slot) = match from {
            Slot::Packed(packed) => {
                (pack::unpack(&packed, *size_px).map_err(|cause| SceneError::io(path, cause))?.into(), None)
            }
            Slot::OnDisk => (self.decode(index)?, None),
            _ => {
                let picture = self.decode(index)?;
                let slot = self.form_of(&picture);
                (picture, Some(slot))
            }
        };
        self.lock().finish(index, &picture, slot, ahead);
        Ok(picture)
    }

    fn decode(&self, index: usize) -> Result<Arc<Picture>, SceneError> {
        let Source { path, size_px } = &self.sources[index];
        let picture = Picture::read_fitted(path, *size_px)?;
        self.lock().count_decoded();
        Ok(Arc::new(picture))
    }

    /// The form in which a picture that was decoded for the first time would best be kept.
    fn form_of(&self, picture: &Arc<Picture>) -> Slot {
        if self.lock().keeps_raw() {
            return Slot::Raw(Arc::clone(picture));
        }
        pack::pack(picture).map_or(Slot::OnDisk, |packed| Slot::Packed(packed.into()))
    }
}

/// Says that making is over, however it ended.
struct Making<'a> {
    shared: &'a Shared,
    index: usize,
}

impl Drop for Making<'_> {
    fn drop(&mut self) {
        self.shared.lock().end(self.index);
        self.shared.changed.notify_all();
    }
}
