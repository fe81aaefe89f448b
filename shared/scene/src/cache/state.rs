//! What the cache holds and the count of its bytes: the part that one lock guards. Nothing here
//! decodes, waits or reads files.

use std::collections::VecDeque;
use std::sync::{Arc, Weak};

use super::{CacheUse, PictureCache, Source, largest_bytes};
use crate::picture::bytes_of;
use crate::{Picture, SceneError};

/// Orders beyond these are passed over: nobody plans further ahead than a few steps.
const ORDERS_MAX: usize = 8;

/// The part of a budget that goes into copies; at least two.
const COPIES_SHARE: u64 = 8;

/// How a picture is kept.
#[derive(Clone)]
pub(super) enum Slot {
    /// Not decoded yet.
    Unseen,
    /// As it is.
    Raw(Arc<Picture>),
    /// Compressed.
    Packed(Arc<[u8]>),
    /// Not at all.
    OnDisk,
}

pub(super) struct State {
    budget_bytes: u64,
    /// For copies in use, made ahead and being made; the rest is for what is kept.
    copies_bytes_max: u64,
    /// Whether all pictures fit raw.
    keeps_raw: bool,
    picture_bytes: Vec<u64>,
    slots: Vec<Slot>,
    /// Bytes in `slots`.
    kept_bytes: u64,
    /// Copies, beside `slots`, that somebody may still hold.
    copies: Vec<(usize, Weak<Picture>)>,
    /// Copies made ahead that nobody has got yet, oldest first.
    ready: VecDeque<(usize, Arc<Picture>)>,
    orders: VecDeque<usize>,
    making: Option<usize>,
    decoded: u64,
    closed: bool,
}

impl State {
    pub(super) fn new(sources: &[Source], budget_bytes: u64) -> Self {
        Self {
            budget_bytes,
            copies_bytes_max: (budget_bytes / COPIES_SHARE).max(2 * largest_bytes(sources)),
            keeps_raw: PictureCache::most_bytes(sources) <= budget_bytes,
            picture_bytes: sources.iter().map(|source| bytes_of(source.size_px)).collect(),
            slots: vec![Slot::Unseen; sources.len()],
            kept_bytes: 0,
            copies: Vec::new(),
            ready: VecDeque::new(),
            orders: VecDeque::new(),
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

    /// The picture, if it is there uncompressed; it is no longer held ready.
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

    /// Orders picture `index` to be made ahead.
    pub(super) fn order(&mut self, index: usize) {
        assert!(index < self.slots.len(), "picture {index} of {}", self.slots.len());
        if self.orders.len() < ORDERS_MAX && !self.orders.contains(&index) {
            self.orders.push_back(index);
        }
    }

    /// The next order that there is room for, if nothing is being made.
    pub(super) fn next_order(&mut self) -> Option<usize> {
        while let Some(&index) = self.orders.front() {
            if self.find(index).is_none() {
                let has_room = self.fits_copies(index) && self.missing_bytes(index) == 0;
                return if has_room && !self.is_making() { self.orders.pop_front() } else { None };
            }
            self.orders.pop_front();
        }
        None
    }

    /// Gives up what was made ahead, oldest first, until picture `index` fits among the copies; and
    /// what is kept compressed where callers hold more copies than that.
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

    /// What the budget lacks to hold picture `index` too.
    fn missing_bytes(&mut self, index: usize) -> u64 {
        (self.used_bytes() + self.picture_bytes[index]).saturating_sub(self.budget_bytes)
    }

    /// Stops keeping one compressed picture, if there is one.
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

    /// Picture `index` is being made from now on. Returns from what.
    pub(super) fn begin(&mut self, index: usize) -> Slot {
        assert!(self.making.is_none(), "two pictures are made at a time");
        self.making = Some(index);
        self.slots[index].clone()
    }

    /// Picture `index` was made, to be kept as `slot` if it was decoded for the first time, and to
    /// be held ready if it was made `ahead`.
    pub(super) fn finish(&mut self, index: usize, picture: &Arc<Picture>, slot: Option<Slot>, ahead: bool) {
        self.end(index);
        let is_raw = matches!(slot, Some(Slot::Raw(_)));
        if !is_raw {
            self.copies.push((index, Arc::downgrade(picture)));
        }
        if let Some(slot) = slot {
            self.keep(index, slot);
        }
        if ahead && !is_raw {
            self.ready.push_back((index, Arc::clone(picture)));
        }
    }

    /// Keeps what there is room for.
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

    /// Picture `index` is no longer being made, whether it was made or not.
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

    /// What is being made, and every copy that is still held somewhere.
    fn copies_bytes(&mut self) -> u64 {
        self.copies.retain(|(_, copy)| copy.strong_count() > 0);
        let copies = self.copies.iter().map(|(index, _)| *index).chain(self.making);
        copies.map(|index| self.picture_bytes[index]).sum()
    }
}
