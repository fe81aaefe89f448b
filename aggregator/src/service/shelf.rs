//! The received models on the disk: complete models, parts of interrupted uploads, and which devices are withdrawn.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use cosurf_link::{ModelKey, ModelStore, Node, StoreError};
use cosurf_wire::{DeviceId, ModelHeader, ModelId};

use super::error::ServiceError;
use super::event::ServiceEvent;
use super::job::{Inputs, Stores};
use super::parts::Parts;
use super::record::{Input, withdrawn, write_withdrawal};

/// The received models in a service's folder.
#[derive(Debug)]
pub(super) struct Shelf {
    folder: PathBuf,
    models: ModelStore,
    /// Headers of all complete models, by device and number.
    stored: BTreeMap<DeviceId, BTreeMap<ModelId, ModelHeader>>,
    /// Parts of models, for devices that have no complete model.
    parts: Parts,
    /// Number of the last withdrawn model of each withdrawn device.
    withdrawn: BTreeMap<DeviceId, ModelId>,
    /// Withdrawn devices whose flights must still be deleted at the broker. Until then, agents may prune ground in
    /// favour of these devices.
    to_void: Vec<DeviceId>,
}

impl Shelf {
    /// Opens the folder of a service. Also returns the headers of the models in it.
    pub(super) fn open(folder: &Path) -> Result<(Self, Vec<ModelHeader>), ServiceError> {
        let (models, headers) = ModelStore::open(&folder.join("models"))?;
        let mut shelf = Self {
            folder: folder.into(),
            models,
            stored: BTreeMap::new(),
            parts: Parts::open(folder)?,
            withdrawn: BTreeMap::new(),
            to_void: Vec::new(),
        };
        headers.iter().for_each(|header| shelf.note(*header));
        shelf.withdraw_devices()?;
        Ok((shelf, headers))
    }

    /// The stores of the models and of the parts.
    pub(super) fn stores(&self) -> Stores {
        Stores { whole: self.models.clone(), parts: self.parts.store().clone() }
    }

    /// Writes a complete model.
    pub(super) fn put(&mut self, header: ModelHeader, body: &[u8]) -> Result<(), StoreError> {
        self.models.put(&header, body)?;
        self.note(header);
        Ok(())
    }

    fn note(&mut self, header: ModelHeader) {
        self.parts.forget(&header.device);
        self.stored.entry(header.device).or_default().insert(header.model, header);
    }

    /// Whether a model is withdrawn.
    pub(super) fn is_withdrawn(&self, header: &ModelHeader) -> bool {
        self.withdrawn.get(&header.device).is_some_and(|last| header.model <= *last)
    }

    /// The devices that have ever been withdrawn.
    pub(super) fn withdrawn_devices(&self) -> impl Iterator<Item = DeviceId> {
        self.withdrawn.keys().copied()
    }

    /// Whether withdrawn models are among the inputs of a merge.
    pub(super) fn has_withdrawn(&self, inputs: &[Input]) -> bool {
        let is_withdrawn = |input: &Input| {
            let mut withdrawn = self.withdrawn.iter();
            withdrawn.any(|(device, last)| device.as_str() == input.device && input.model <= last.0)
        };
        inputs.iter().any(is_withdrawn)
    }

    /// Whether devices are withdrawn and nothing is left to merge.
    pub(super) fn is_emptied(&self) -> bool {
        !self.withdrawn.is_empty() && self.inputs() == Inputs::default()
    }

    /// The newest model of each device, in order of device id.
    pub(super) fn newest(&self) -> Vec<ModelHeader> {
        self.stored.values().filter_map(|models| models.last_key_value()).map(|(_, header)| *header).collect()
    }

    /// The models to merge: the newest model of each device, and the parts of devices without a complete model.
    pub(super) fn inputs(&self) -> Inputs {
        Inputs { whole: self.newest(), parts: self.parts.headers().collect() }
    }

    /// Stores the parts that have arrived so far from devices without a complete model. If a part cannot be written,
    /// the other models are merged all the same. Returns the events to report.
    pub(super) fn take_parts(&mut self, node: &Node) -> Vec<ServiceEvent> {
        let wanted = node.unfinished().filter(|header| {
            let is_here = self.stored.get(&header.device).is_some_and(|models| !models.is_empty());
            !is_here && !self.is_withdrawn(header)
        });
        let wanted: Vec<ModelHeader> = wanted.copied().collect();
        wanted.iter().filter_map(|header| take_part(&mut self.parts, node, header)).collect()
    }

    /// Removes the models of withdrawn devices. Returns the first device of which a model or a part was removed.
    pub(super) fn withdraw_devices(&mut self) -> Result<Option<DeviceId>, ServiceError> {
        let mut first = None;
        for (device, last) in withdrawn(&self.folder) {
            let last = match last {
                Some(last) => last,
                None => self.record_withdrawal(device)?,
            };
            if self.withdraw(device, last)? {
                first = first.or(Some(device));
            }
        }
        Ok(first)
    }

    /// Records the newest model received from a device as the device's last withdrawn model. A device that was
    /// withdrawn before may have sent nothing since; then the number stays.
    fn record_withdrawal(&mut self, device: DeviceId) -> Result<ModelId, ServiceError> {
        let newest = self.stored.get(&device).and_then(|models| models.keys().next_back().copied());
        let before = self.withdrawn.get(&device).copied();
        let last = newest.max(self.parts.model_of(&device)).max(before).unwrap_or(ModelId(0));
        write_withdrawal(&self.folder, &device, last)?;
        self.to_void.push(device);
        Ok(last)
    }

    /// Removes the models of a device up to number `last`. Returns whether there were any.
    fn withdraw(&mut self, device: DeviceId, last: ModelId) -> Result<bool, ServiceError> {
        self.withdrawn.insert(device, last);
        let has_part = self.parts.model_of(&device).is_some_and(|part| part <= last);
        if has_part {
            self.parts.forget(&device);
        }
        let Some(stored) = self.stored.get_mut(&device) else { return Ok(has_part) };
        let gone: Vec<ModelId> = stored.range(..=last).map(|(model, _)| *model).collect();
        for &model in &gone {
            self.models.remove(ModelKey { device, model })?;
            stored.remove(&model);
        }
        Ok(has_part || !gone.is_empty())
    }

    /// Devices withdrawn since the last call. Their announced flights must be deleted.
    pub(super) fn take_void_flights(&mut self) -> impl Iterator<Item = DeviceId> {
        self.to_void.drain(..)
    }
}

fn take_part(parts: &mut Parts, node: &Node, header: &ModelHeader) -> Option<ServiceEvent> {
    match parts.take(node, header) {
        Ok(part) => part.map(|part| ServiceEvent::PartTaken { header: part, of_splats: header.splats }),
        Err(error) => {
            let reason =
                format!("the part of the model of {} that has arrived is not used: {error}", header.device);
            Some(ServiceEvent::DiskFailed { reason })
        }
    }
}
