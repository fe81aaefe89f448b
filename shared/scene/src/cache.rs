//! A cache of the training pictures at training size, within a byte budget. Each picture is decoded
//! and shrunk once. It is then kept raw if all pictures fit, else compressed (`pack`) while there is
//! room, else read from disk again.
//!
//! Compressed pictures stay in the cache unless callers hold more than two pictures. Evicting the
//! oldest for the newest would, in each epoch of training, evict every picture just before its use.
//!
//! An eighth of the budget, and at least two pictures, is reserved for copies: raw pictures that are
//! handed out, prefetched or being made. The rest is for the pictures that are kept.
//!
//! Only one picture is decoded at a time, by the caller of [`PictureCache::get`] or by the thread that
//! serves [`PictureCache::prefetch`]. So the memory for decoding is known in advance
//! ([`PictureCache::scratch_bytes`]). Every form holds the same pixels, so results computed from a
//! picture do not depend on timing or budget.

mod pack;
mod source;
mod state;
#[cfg(test)]
mod tests;

use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};

use crate::{Picture, SceneError};
pub use source::Source;
use source::{largest_bytes, total_bytes};
pub use state::CacheUse;
use state::{Slot, State};

/// A cache of pictures within a byte budget; see the module. Threads share it by reference.
pub struct PictureCache {
    shared: Arc<Shared>,
    prefetcher: Option<JoinHandle<()>>,
}

struct Shared {
    sources: Vec<Source>,
    state: Mutex<State>,
    /// Wakes the threads that wait for a change of the state.
    changed: Condvar,
}

impl PictureCache {
    /// A cache over `sources` that holds at most `budget_bytes` of pictures, including those handed out
    /// and prefetched. Reads no file yet. Errors: a budget below [`Self::least_bytes`].
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
        // If the thread cannot be started, `get` decodes every picture.
        Ok(Self { shared, prefetcher: prefetcher.ok() })
    }

    /// The smallest budget that works: two pictures of the largest size, one in use and one being
    /// made, or all pictures if that is less.
    pub fn least_bytes(sources: &[Source]) -> u64 {
        (2 * largest_bytes(sources)).min(total_bytes(sources))
    }

    /// The budget that holds all pictures raw; a larger one brings no gain.
    pub fn most_bytes(sources: &[Source]) -> u64 {
        total_bytes(sources)
    }

    /// Bytes that decoding, shrinking and compressing the most demanding source takes temporarily, on
    /// top of the budget. Reads the header of every file.
    pub fn scratch_bytes(sources: &[Source]) -> Result<u64, SceneError> {
        let mut most = pack::scratch_bytes(largest_bytes(sources));
        for source in sources {
            most = most.max(Picture::scratch_bytes(&source.path, source.size_px)?);
        }
        Ok(most)
    }

    /// Picture `index` at its source's size. A returned picture counts towards the budget until it is
    /// dropped. Errors: an unreadable file, or a budget without room for the picture; the least budget
    /// has room for one picture while another is held.
    pub fn get(&self, index: usize) -> Result<Arc<Picture>, SceneError> {
        let shared = &self.shared;
        let mut state = shared.lock();
        // The prefetcher may be waiting for memory that the caller has released by now.
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

    /// Asks the background thread to prefetch picture `index`. Returns at once; ignored if too many
    /// requests are waiting.
    pub fn prefetch(&self, index: usize) {
        self.shared.lock().request(index);
        self.shared.changed.notify_all();
    }

    /// The current contents of the cache.
    pub fn usage(&self) -> CacheUse {
        self.shared.lock().usage()
    }
}

impl Drop for PictureCache {
    fn drop(&mut self) {
        self.shared.lock().close();
        self.shared.changed.notify_all();
        if let Some(prefetcher) = self.prefetcher.take() {
            // If the thread panicked, its message was printed, and `get` decoded the pictures.
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

    /// The background thread: makes the requested pictures as room allows.
    fn prefetch_all(&self) {
        let mut state = self.lock();
        while !state.is_closed() {
            match state.next_request() {
                Some(index) => {
                    // `get` of the same picture meets the same error and returns it.
                    let _ = self.make(state, index, true);
                    state = self.lock();
                }
                None => state = self.wait(state),
            }
        }
    }

    /// Makes picture `index` from its compressed form or its file, with the lock released meanwhile;
    /// holds the picture for `get` if this is a `prefetch`. There must be room for it, and no other picture
    /// may be in the making.
    fn make(
        &self,
        mut state: MutexGuard<'_, State>,
        index: usize,
        prefetch: bool,
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
        self.lock().finish(index, &picture, slot, prefetch);
        Ok(picture)
    }

    fn decode(&self, index: usize) -> Result<Arc<Picture>, SceneError> {
        let Source { path, size_px } = &self.sources[index];
        let picture = Picture::read_fitted(path, *size_px)?;
        self.lock().count_decoded();
        Ok(Arc::new(picture))
    }

    /// The best form in which to keep a picture that was decoded for the first time.
    fn form_of(&self, picture: &Arc<Picture>) -> Slot {
        if self.lock().keeps_raw() {
            return Slot::Raw(Arc::clone(picture));
        }
        pack::pack(picture).map_or(Slot::OnDisk, |packed| Slot::Packed(packed.into()))
    }
}

/// Ends the making of a picture on drop, whether it succeeded or not.
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
