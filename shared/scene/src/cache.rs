//! A cache of the pictures for training, within a byte budget. A picture is decoded and shrunk to its
//! training size when it is first needed. If all pictures fit into the budget, they are kept raw, that is,
//! uncompressed. Otherwise they are kept compressed (module `pack`) while there is room. A picture without
//! room is decoded from its file at each use.
//!
//! A compressed picture stays in the cache, unless callers hold so many pictures at once that its memory is
//! needed. Evicting the oldest picture for the newest would be worse: each epoch of training uses every
//! picture, so each would be evicted just before its next use.
//!
//! If not all pictures fit raw, part of the budget is reserved for copies: raw pictures that callers hold,
//! that are prefetched or that are being made. This part is an eighth of the budget, or two pictures if
//! that is more. The rest is for the pictures that are kept.
//!
//! Only one picture is decoded at a time, by the caller of [`PictureCache::get`] or by the thread that
//! serves [`PictureCache::prefetch`]. So the memory for decoding is known in advance
//! ([`PictureCache::scratch_bytes`]). Raw, compressed or from its file, a picture has the same pixels, so
//! results computed from it do not depend on timing or budget.

mod pack;
mod source;
mod state;
#[cfg(test)]
mod tests;

use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};

use crate::{Picture, SceneError, mask};
pub use source::Source;
use source::{largest_bytes, total_bytes};
pub use state::CacheUse;
use state::{Slot, State};

/// A cache of pictures within a byte budget; see the [module](self). Several threads can use it at once,
/// through shared references.
pub struct PictureCache {
    shared: Arc<Shared>,
    prefetcher: Option<JoinHandle<()>>,
}

struct Shared {
    sources: Vec<Source>,
    state: Mutex<State>,
    /// Wakes the threads that wait for the state to change.
    changed: Condvar,
}

impl PictureCache {
    /// A cache of `sources` that holds at most `budget_bytes` of pictures, including those that callers
    /// hold and those that are prefetched. Reads no file yet. Errors: a budget below [`Self::least_bytes`].
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
        // If the thread cannot be started, `get` decodes every picture in the caller's thread.
        Ok(Self { shared, prefetcher: prefetcher.ok() })
    }

    /// The smallest budget that works, bytes: two pictures of the largest size, one in use and one being
    /// made; or all pictures, if they take less.
    pub fn least_bytes(sources: &[Source]) -> u64 {
        (2 * largest_bytes(sources)).min(total_bytes(sources))
    }

    /// The budget that holds all pictures raw, bytes. A larger budget brings no gain.
    pub fn most_bytes(sources: &[Source]) -> u64 {
        total_bytes(sources)
    }

    /// Upper bound on the temporary memory, bytes, that decoding, shrinking and compressing a picture takes
    /// besides the budget, for the most demanding of `sources`. Reads the header of every file.
    pub fn scratch_bytes(sources: &[Source]) -> Result<u64, SceneError> {
        let mut most = pack::scratch_bytes(largest_bytes(sources));
        for source in sources {
            let Source { path, mask, size_px, shrinking } = source;
            most = most.max(mask::scratch_bytes(path, mask.as_ref(), *size_px, *shrinking)?);
        }
        Ok(most)
    }

    /// Returns picture `index`, shrunk to the size in its [`Source`]. The picture counts towards the budget
    /// until it is dropped. Errors: an unreadable file; no room for the picture, because callers hold too
    /// many others. Even the smallest budget has room for a picture while callers hold one other.
    pub fn get(&self, index: usize) -> Result<Arc<Picture>, SceneError> {
        let shared = &self.shared;
        let mut state = shared.lock();
        // The prefetching thread may be waiting for memory that the caller has released by now.
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

    /// Asks the background thread to make picture `index` before it is needed. Returns at once. The request
    /// is ignored if too many requests are waiting.
    pub fn prefetch(&self, index: usize) {
        self.shared.lock().request(index);
        self.shared.changed.notify_all();
    }

    /// How much the cache holds at this moment.
    pub fn usage(&self) -> CacheUse {
        self.shared.lock().usage()
    }
}

impl Drop for PictureCache {
    fn drop(&mut self) {
        self.shared.lock().close();
        self.shared.changed.notify_all();
        if let Some(prefetcher) = self.prefetcher.take() {
            // If the thread has panicked, its message was printed, and `get` decoded the pictures instead.
            let _ = prefetcher.join();
        }
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wait<'a>(&self, state: MutexGuard<'a, State>) -> MutexGuard<'a, State> {
        self.changed.wait(state).unwrap_or_else(PoisonError::into_inner)
    }

    /// Runs in the background thread until the cache is closed: makes the requested pictures whenever there
    /// is room for them.
    fn prefetch_all(&self) {
        let mut state = self.lock();
        while !state.is_closed() {
            match state.next_request() {
                Some(index) => {
                    // An error is ignored here, because `get` of the same picture meets it again and
                    // returns it.
                    let _ = self.make(state, index, true);
                    state = self.lock();
                }
                None => state = self.wait(state),
            }
        }
    }

    /// Makes picture `index` from its compressed form or its file. The lock is released during this work.
    /// With `prefetch`, the cache holds the picture until `get` takes it or needs its memory. There must be
    /// room for the picture, and no other picture may be in the making.
    fn make(
        &self,
        mut state: MutexGuard<'_, State>,
        index: usize,
        prefetch: bool,
    ) -> Result<Arc<Picture>, SceneError> {
        let from = state.begin(index);
        drop(state);
        let _making = Making { shared: self, index };
        let Source { path, size_px, .. } = &self.sources[index];
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
        self.lock().finish(index, &picture, slot, prefetch);
        Ok(picture)
    }

    fn decode(&self, index: usize) -> Result<Arc<Picture>, SceneError> {
        let Source { path, mask, size_px, shrinking } = &self.sources[index];
        let picture = mask::read(path, mask.as_ref(), *size_px, *shrinking)?;
        self.lock().count_decoded();
        Ok(Arc::new(picture))
    }

    /// Chooses the form in which to keep a picture that was decoded for the first time.
    fn form_of(&self, picture: &Arc<Picture>) -> Slot {
        if self.lock().keeps_raw() {
            return Slot::Raw(Arc::clone(picture));
        }
        pack::pack(picture).map_or(Slot::OnDisk, |packed| Slot::Packed(packed.into()))
    }
}

/// A guard. When the guard is dropped, after success or failure, it marks the picture as no longer being
/// made and wakes the waiting threads.
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
