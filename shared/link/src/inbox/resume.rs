//! Goes on with transfers that were not finished when the program ended.

use std::path::Path;
use std::time::Duration;

use cosurf_scene::LocalFrame;
use cosurf_wire::{ModelHeader, Topic};

use super::{Inbox, InboxEvent};
use crate::arrived::ArrivedStore;
use crate::body::Model;
use crate::key::ModelKey;
use crate::store::StoreError;
use crate::transfer::{ChunkOutcome, Transfer};

impl Inbox {
    /// Keeps what arrives of unfinished models in a folder, which may be that of a [`crate::ModelStore`], and goes on with
    /// what is there as soon as it is offered again. The folder takes as many bytes as the inbox, at most.
    pub fn keep_arrived(&mut self, folder: &Path) -> Result<(), StoreError> {
        let mut arrived = ArrivedStore::open(folder, self.limits.total_bytes_max)?;
        arrived.remove_all(|key| self.stored.contains_key(key));
        self.arrived = Some(arrived);
        Ok(())
    }

    /// Takes what had arrived before of a model that is offered again.
    pub(super) fn resume(&mut self, now: Duration, key: ModelKey) -> Option<InboxEvent> {
        let header = self.transfers.get(&key)?.header;
        let bytes = self.arrived.as_ref()?.bytes_of(&header);
        if bytes == 0 {
            return None;
        }
        self.transfers.get_mut(&key)?.expect(bytes);
        self.make_room_for_more(now, key);
        let (arrived, transfer) = (self.arrived.as_mut()?, self.transfers.get_mut(&key)?);
        let here = arrived.read(&header, |first, chunk| transfer.place(first, chunk));
        match transfer.resume(now, &here) {
            ChunkOutcome::BadBody(reason) => self.refuse(key, reason),
            ChunkOutcome::Bad => {
                arrived.remove(key);
                None
            }
            ChunkOutcome::Taken | ChunkOutcome::Known => None,
        }
    }

    /// Keeps a chunk that has just been taken.
    pub(super) fn keep_chunk(&mut self, key: ModelKey, index: u32, chunk: &[u8]) {
        let (Some(arrived), Some(transfer)) = (&mut self.arrived, self.transfers.get(&key)) else { return };
        if let Some(range) = transfer.header.chunk_range(index) {
            arrived.add(&transfer.header, range.start, chunk);
        }
    }

    /// Removes what is kept of models for which `is_it` holds.
    pub(super) fn drop_arrived(&mut self, is_it: impl Fn(&ModelKey) -> bool) {
        if let Some(arrived) = &mut self.arrived {
            arrived.remove_all(is_it);
        }
    }

    /// Headers of the models of which only a part is here. If the part came before a restart, and its sender has not offered
    /// the model since, it is listed until [`Self::part`] is called.
    pub fn unfinished(&self) -> impl Iterator<Item = &ModelHeader> {
        let fetching = self.transfers.values().filter(|transfer| transfer.is_fetching());
        let kept = self.arrived.iter().flat_map(ArrivedStore::unused);
        let kept = kept.filter(|header| !self.transfers.contains_key(&ModelKey::from(*header)));
        fetching.map(|transfer| &transfer.header).chain(kept)
    }

    /// Decodes the packs of an unfinished model that have arrived into the body's own frame, which is returned. Returns
    /// `None` if no splats have arrived or the packs are invalid. Also returns `None` if models must be signed: the
    /// signature covers the hash of the whole body, which cannot be checked before the body is complete.
    pub fn part(&mut self, key: ModelKey) -> Option<(LocalFrame, Model)> {
        if self.credentials.trusted.is_some() {
            return None;
        }
        match self.transfers.get(&key) {
            Some(transfer) => transfer.part(),
            None => self.kept_part(key),
        }
    }

    fn kept_part(&mut self, key: ModelKey) -> Option<(LocalFrame, Model)> {
        let room = self.limits.total_bytes_max.saturating_sub(self.unfinished_bytes());
        let arrived = self.arrived.as_mut()?;
        let header = arrived.begin_to_use(key)?;
        if header.body_bytes > room || header.unpacked_bytes() > self.limits.body_bytes_max {
            return None;
        }
        let topic = Topic::LocalHeader { device: key.device, model: key.model };
        let mut transfer = Transfer::new(Duration::ZERO, header, 0, header.body_bytes, topic);
        let here = arrived.read(&header, |first, chunk| transfer.place(first, chunk));
        transfer.resume(Duration::ZERO, &here);
        transfer.part()
    }
}
