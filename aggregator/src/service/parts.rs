//! Stores the parts of unfinished uploads that merges use ([`crate::merge::fill_in()`]).

use std::collections::BTreeMap;
use std::path::Path;

use cosurf_link::{
    Damaged, FirstLayer, ModelStore, Node, Offer, StoreError, model_to_body, plain_importance,
};
use cosurf_wire::{DeviceId, ModelHeader, ModelId};

use super::error::ServiceError;
use super::folder::parts;

/// The stored parts, at most one for each device.
#[derive(Debug)]
pub(super) struct Parts {
    store: ModelStore,
    /// Header of each device's part, which is stored like a model of its own.
    headers: BTreeMap<DeviceId, ModelHeader>,
}

impl Parts {
    /// `tell` gets the files that were set aside.
    pub(super) fn open(folder: &Path, tell: impl FnMut(Damaged)) -> Result<Self, StoreError> {
        let (store, headers) = ModelStore::open_telling(&parts(folder), tell)?;
        Ok(Self { store, headers: headers.into_iter().map(|header| (header.device, header)).collect() })
    }

    pub(super) fn store(&self) -> &ModelStore {
        &self.store
    }

    /// Headers of all parts, in order of device id.
    pub(super) fn headers(&self) -> impl Iterator<Item = ModelHeader> {
        self.headers.values().copied()
    }

    /// Stores the part of an unfinished model that has arrived at `node`, if it has more splats than the
    /// stored part of the same device. Returns the header of the new part.
    pub(super) fn take(
        &mut self,
        node: &mut Node,
        unfinished: &ModelHeader,
    ) -> Result<Option<ModelHeader>, ServiceError> {
        let ModelHeader { device, model, kind, views, frame, .. } = *unfinished;
        let before = self.headers.get(&device).copied();
        let is_more = |splats: usize| before.is_none_or(|before| splats > before.splats as usize);
        let part = node.part(unfinished.into()).filter(|(_, part)| is_more(part.splats.len()));
        let Some((its_frame, part)) = part else { return Ok(None) };
        let importance = plain_importance(&part.splats);
        let first = FirstLayer::ByImportance(&importance);
        let body = model_to_body(&part.splats, &part.cameras, &its_frame, first)?;
        let mut offer = Offer::from_body(device, model, kind, views, body)?;
        offer.header.frame = frame;
        self.store.put(&offer.header, &offer.body)?;
        self.headers.insert(device, offer.header);
        if let Some(before) = before.filter(|before| before.model != model) {
            self.store.remove(before.into())?;
        }
        Ok(Some(offer.header))
    }

    /// The model to which a device's stored part belongs.
    pub(super) fn model_of(&self, device: &DeviceId) -> Option<ModelId> {
        self.headers.get(device).map(|part| part.model)
    }

    /// Removes a device's part, because its model has arrived completely or was withdrawn.
    pub(super) fn forget(&mut self, device: &DeviceId) {
        if let Some(part) = self.headers.remove(device) {
            // If the file cannot be removed, the service removes it when it starts again.
            let _ = self.store.remove(part.into());
        }
    }
}
