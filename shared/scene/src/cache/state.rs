//! The contents of a cache, and the count of the bytes that they take. One lock guards both. Nothing in
//! this module decodes pictures, waits or reads files.

use std::collections::VecDeque;
use std::sync::{Arc, Weak};

use super::source::{Source, largest_bytes, total_bytes};
use crate::picture::bytes_of;
use crate::{Picture, SceneError};

/// Largest number of prefetch requests that may wait; training looks only a few steps ahead.
const REQUESTS_MAX: usize = 8;

/// The part of the budget for copies (see `copies_bytes_max`) is the budget divided by this number, but
/// at least two pictures of the largest size.
const COPIES_SHARE: u64 = 8;

/// How much a cache holds at one moment.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CacheUse {
    /// Bytes of pictures in any form, including those that callers hold and the one that is being made;
    /// never above the budget.
    pub used_bytes: u64,
    /// Number of pictures kept uncompressed.
    pub raw: usize,
    /// Number of pictures kept compressed.
    pub packed: usize,
    /// Number of pictures that are read from disk at each use, because the cache has no room for them.
    pub on_disk: usize,
    /// Number of times that a picture file was decoded.
    pub decoded: u64,
}

/// How a picture is kept.
#[derive(Clone)]
pub(super) enum Slot {
    /// Not decoded yet.
    Unseen,
    /// Uncompressed.
    Raw(Arc<Picture>),
    /// Compressed.
    Packed(Arc<[u8]>),
    /// Not kept: read from disk at each use.
    OnDisk,
}

pub(super) struct State {
    budget_bytes: u64,
    /// The part of the budget for copies: raw pictures that callers hold, that are prefetched or that are
    /// being made. The rest is for `slots`.
    copies_bytes_max: u64,
    /// Whether all pictures fit into the budget uncompressed.
    keeps_raw: bool,
    picture_bytes: Vec<u64>,
    slots: Vec<Slot>,
    /// Bytes of the pictures in `slots`.
    kept_bytes: u64,
    /// Uncompressed pictures outside `slots`, by index. Some may have been dropped by their holders since.
    copies: Vec<(usize, Weak<Picture>)>,
    /// Prefetched pictures that `get` has not returned yet, with their indices, oldest first.
    ready: VecDeque<(usize, Arc<Picture>)>,
    /// Indices of the pictures to prefetch, oldest request first.
    requests: VecDeque<usize>,
    /// Index of the picture that is being made.
    making: Option<usize>,
    decoded: u64,
    closed: bool,
}

impl State {
    pub(super) fn new(sources: &[Source], budget_bytes: u64) -> Self {
        Self {
            budget_bytes,
            copies_bytes_max: (budget_bytes / COPIES_SHARE).max(2 * largest_bytes(sources)),
            keeps_raw: total_bytes(sources) <= budget_bytes,
            picture_bytes: sources.iter().map(|source| bytes_of(source.size_px)).collect(),
            slots: vec![Slot::Unseen; sources.len()],
            kept_bytes: 0,
            copies: Vec::new(),
            ready: VecDeque::new(),
            requests: VecDeque::new(),
            making: None,
            decoded: 0,
            closed: false,
        }
    }

    pub(super) fn keeps_raw(&self) -> bool {
        self.keeps_raw
    }

    pub(super) fn is_making(&self) -> bool {
        self.making.is_some()
    }

    /// Returns picture `index` if it is in memory uncompressed. From then on it no longer counts as
    /// prefetched.
    pub(super) fn take(&mut self, index: usize) -> Option<Arc<Picture>> {
        let picture = self.find(index)?;
        self.ready.retain(|(ready, _)| *ready != index);
        Some(picture)
    }

    fn find(&self, index: usize) -> Option<Arc<Picture>> {
        match &self.slots[index] {
            Slot::Raw(picture) => Some(Arc::clone(picture)),
            _ => self.copies.iter().filter(|(copy, _)| *copy == index).find_map(|(_, copy)| copy.upgrade()),
        }
    }

    /// Queues picture `index` for prefetching, unless the queue is full or has it already.
    pub(super) fn request(&mut self, index: usize) {
        assert!(index < self.slots.len(), "picture {index} of {}", self.slots.len());
        if self.requests.len() < REQUESTS_MAX && !self.requests.contains(&index) {
            self.requests.push_back(index);
        }
    }

    /// Takes the oldest request whose picture is not in memory uncompressed; drops the older requests.
    /// `None` if there is no such request, no room for the picture, or another picture is being made.
    pub(super) fn next_request(&mut self) -> Option<usize> {
        while let Some(&index) = self.requests.front() {
            if self.find(index).is_none() {
                let has_room = self.fits_copies(index) && self.missing_bytes(index) == 0;
                return if has_room && !self.is_making() { self.requests.pop_front() } else { None };
            }
            self.requests.pop_front();
        }
        None
    }

    /// Drops prefetched pictures, oldest first, until picture `index` fits into the part of the budget for
    /// copies. If callers hold too many copies for that, drops compressed pictures until the picture fits
    /// into the whole budget. Errors: it does not fit even then.
    pub(super) fn make_room(&mut self, index: usize) -> Result<(), SceneError> {
        while !self.fits_copies(index) && self.ready.pop_front().is_some() {}
        while self.missing_bytes(index) > 0 {
            if !self.drop_packed() {
                let (budget_bytes, missing_bytes) = (self.budget_bytes, self.missing_bytes(index));
                let needed_bytes = budget_bytes + missing_bytes;
                return Err(SceneError::OverBudget { needed_bytes, budget_bytes });
            }
        }
        Ok(())
    }

    fn fits_copies(&mut self, index: usize) -> bool {
        self.keeps_raw || self.copies_bytes() + self.picture_bytes[index] <= self.copies_bytes_max
    }

    /// Bytes by which picture `index`, added to the present contents, would exceed the budget.
    fn missing_bytes(&mut self, index: usize) -> u64 {
        (self.used_bytes() + self.picture_bytes[index]).saturating_sub(self.budget_bytes)
    }

    /// Drops one compressed picture; false if the cache has none.
    fn drop_packed(&mut self) -> bool {
        let Some(slot) = self.slots.iter_mut().find(|slot| matches!(slot, Slot::Packed(_))) else {
            return false;
        };
        if let Slot::Packed(packed) = slot {
            self.kept_bytes -= packed.len() as u64;
        }
        *slot = Slot::OnDisk;
        true
    }

    /// Marks picture `index` as being made. Returns the form from which to make it.
    pub(super) fn begin(&mut self, index: usize) -> Slot {
        assert!(self.making.is_none(), "only one picture may be made at a time");
        self.making = Some(index);
        self.slots[index].clone()
    }

    /// Records that picture `index` was made. `slot` is given after the first decoding only; it is the
    /// form in which to keep the picture. With `prefetch`, the picture is held until `get` takes it or
    /// needs its memory.
    pub(super) fn finish(
        &mut self,
        index: usize,
        picture: &Arc<Picture>,
        slot: Option<Slot>,
        prefetch: bool,
    ) {
        self.end(index);
        let is_raw = matches!(slot, Some(Slot::Raw(_)));
        if !is_raw {
            self.copies.push((index, Arc::downgrade(picture)));
        }
        if let Some(slot) = slot {
            self.keep(index, slot);
        }
        if prefetch && !is_raw {
            self.ready.push_back((index, Arc::clone(picture)));
        }
    }

    /// Keeps picture `index` in the form `slot` if there is room for it; otherwise leaves the picture on
    /// disk.
    fn keep(&mut self, index: usize, slot: Slot) {
        let (bytes, bytes_max) = match &slot {
            Slot::Raw(_) => (self.picture_bytes[index], self.budget_bytes),
            Slot::Packed(packed) => {
                (packed.len() as u64, self.budget_bytes.saturating_sub(self.copies_bytes_max))
            }
            Slot::Unseen | Slot::OnDisk => (0, self.budget_bytes),
        };
        let fits = self.kept_bytes + bytes <= bytes_max && self.used_bytes() + bytes <= self.budget_bytes;
        self.slots[index] = if fits { slot } else { Slot::OnDisk };
        self.kept_bytes += if fits { bytes } else { 0 };
    }

    /// Marks picture `index` as no longer being made, after success or failure.
    pub(super) fn end(&mut self, index: usize) {
        if self.making == Some(index) {
            self.making = None;
        }
    }

    pub(super) fn count_decoded(&mut self) {
        self.decoded += 1;
    }

    pub(super) fn close(&mut self) {
        self.closed = true;
    }

    pub(super) fn is_closed(&self) -> bool {
        self.closed
    }

    pub(super) fn usage(&mut self) -> CacheUse {
        let count = |is: fn(&Slot) -> bool| self.slots.iter().filter(|slot| is(slot)).count();
        let (raw, packed, on_disk) = (
            count(|slot| matches!(slot, Slot::Raw(_))),
            count(|slot| matches!(slot, Slot::Packed(_))),
            count(|slot| matches!(slot, Slot::OnDisk)),
        );
        CacheUse { used_bytes: self.used_bytes(), raw, packed, on_disk, decoded: self.decoded }
    }

    fn used_bytes(&mut self) -> u64 {
        self.kept_bytes + self.copies_bytes()
    }

    /// Bytes of the picture that is being made, and of every copy that somebody still holds.
    fn copies_bytes(&mut self) -> u64 {
        self.copies.retain(|(_, copy)| copy.strong_count() > 0);
        let copies = self.copies.iter().map(|(index, _)| *index).chain(self.making);
        copies.map(|index| self.picture_bytes[index]).sum()
    }
}
