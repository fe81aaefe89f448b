//! The received models on the disk: complete models, parts of interrupted uploads, and which devices are withdrawn.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use cosurf_link::{Damaged, ModelKey, ModelStore, Node, StoreError};
use cosurf_scene::SceneError;
use cosurf_wire::{BodyHash, DeviceId, ModelHeader, ModelId};

use super::error::ServiceError;
use super::event::ServiceEvent;
use super::flights::Flights;
use super::folder::models;
use super::inputs::{Input, Inputs};
use super::job::Stores;
use super::model_list::{ModelList, any_listed};
use super::parts::Parts;
use super::record::WITHDRAWN;

/// Models of a device that are kept. Older ones are removed, since only the newest is merged.
const KEPT_OF_DEVICE: usize = 4;
/// The folder with the lists of removed older models.
const REPLACED: &str = "replaced";

/// The received models in a service's folder.
#[derive(Debug)]
pub(super) struct Shelf {
    folder: PathBuf,
    models: ModelStore,
    /// Headers of all complete models, by device and number.
    stored: BTreeMap<DeviceId, BTreeMap<ModelId, ModelHeader>>,
    /// Parts of models, for devices that have no complete model.
    parts: Parts,
    /// The withdrawn models of each withdrawn device.
    withdrawn: BTreeMap<DeviceId, ModelList>,
    /// The flights of which devices will send models.
    flights: Flights,
    /// Withdrawn models that the link must forget, so that it does not acknowledge them again.
    to_forget: Vec<ModelKey>,
    /// Withdrawn devices whose flights must still be deleted at the broker. Until then, agents may prune ground in
    /// favour of these devices.
    to_void: Vec<DeviceId>,
    /// Withdrawn devices that nobody was told of yet.
    untold: Vec<DeviceId>,
    /// Models whose files were set aside at the start, and that no newer one replaces.
    damaged: Vec<ModelKey>,
}

impl Shelf {
    /// Opens the folder of a service for its session `session`. Also returns the headers of the models in it. `tell` gets the
    /// files that were set aside, and what follows.
    pub(super) fn open(
        folder: &Path,
        session: u64,
        mut tell: impl FnMut(Damaged, &str),
    ) -> Result<(Self, Vec<ModelHeader>), ServiceError> {
        let mut damaged = Vec::new();
        let (models, mut headers) = ModelStore::open_telling(&models(folder), |file| damaged.push(file))?;
        let mut shelf = Self {
            folder: folder.into(),
            models,
            stored: BTreeMap::new(),
            parts: Parts::open(folder, |file| tell(file, "the part is left out"))?,
            withdrawn: BTreeMap::new(),
            flights: Flights::new(session),
            to_forget: Vec::new(),
            to_void: Vec::new(),
            untold: Vec::new(),
            damaged: Vec::new(),
        };
        headers.iter().for_each(|header| shelf.note(*header));
        shelf.remove_withdrawn()?;
        headers.retain(|header| shelf.has(header));
        for file in damaged {
            match file.key.filter(|key| shelf.lacks_model(*key, ModelList::has_part)) {
                Some(key) => {
                    shelf.damaged.push(key);
                    tell(file, &format!("{} is asked for it again", key.device));
                }
                None => tell(file, "it is not needed"),
            }
        }
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

    fn has(&self, header: &ModelHeader) -> bool {
        self.stored.get(&header.device).is_some_and(|models| models.contains_key(&header.model))
    }

    /// Whether a device has a complete model here.
    pub(super) fn knows(&self, device: &DeviceId) -> bool {
        self.stored.get(device).is_some_and(|models| !models.is_empty())
    }

    /// Number of devices with a complete model.
    pub(super) fn devices(&self) -> usize {
        self.stored.values().filter(|models| !models.is_empty()).count()
    }

    /// Removes the oldest models of a device beyond [`KEPT_OF_DEVICE`], except those that a running merge reads.
    pub(super) fn remove_replaced(&mut self, device: DeviceId, in_use: &[Input]) -> Result<(), ServiceError> {
        let Some(stored) = self.stored.get_mut(&device) else { return Ok(()) };
        let is_in_use = |header: &ModelHeader| in_use.contains(&Input::whole(header));
        let old = stored.len().saturating_sub(KEPT_OF_DEVICE);
        let old: Vec<ModelHeader> =
            stored.values().take(old).filter(|old| !is_in_use(old)).copied().collect();
        if old.is_empty() {
            return Ok(());
        }
        let folder = self.folder.join(REPLACED);
        let mut replaced = ModelList::read(&folder, &device);
        old.iter().for_each(|header| replaced.add(header));
        replaced.write(&folder, &device)?;
        for header in old {
            self.models.remove(header.into())?;
            stored.remove(&header.model);
        }
        Ok(())
    }

    /// Whether a model is withdrawn.
    pub(super) fn is_withdrawn(&self, header: &ModelHeader) -> bool {
        let listed = self.withdrawn.get(&header.device);
        listed.is_some_and(|listed| listed.has(header.model, &header.blake3.to_string()))
    }

    /// The devices that have ever been withdrawn.
    pub(super) fn withdrawn_devices(&self) -> impl Iterator<Item = DeviceId> {
        self.withdrawn.keys().copied()
    }

    /// Whether withdrawn models are among the inputs of a merge.
    pub(super) fn has_withdrawn(&self, inputs: &[Input]) -> bool {
        any_listed(&self.withdrawn, inputs)
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
    pub(super) fn take_parts(&mut self, node: &mut Node) -> Vec<ServiceEvent> {
        let wanted =
            node.unfinished().filter(|header| !self.knows(&header.device) && !self.is_withdrawn(header));
        let wanted: Vec<ModelHeader> = wanted.copied().collect();
        wanted.iter().filter_map(|header| take_part(&mut self.parts, node, header)).collect()
    }

    /// Removes the models of withdrawn devices. Returns the devices of which a model or a part was removed since the last call,
    /// or at the start.
    pub(super) fn withdraw_devices(&mut self) -> Result<Vec<DeviceId>, ServiceError> {
        self.remove_withdrawn()?;
        Ok(std::mem::take(&mut self.untold))
    }

    fn remove_withdrawn(&mut self) -> Result<(), ServiceError> {
        for (device, mut listed) in ModelList::read_all(&self.folder.join(WITHDRAWN))? {
            if listed.asks {
                self.list_models(device, &mut listed)?;
            }
            if self.withdraw(device, listed)? {
                self.untold.push(device);
            }
        }
        Ok(())
    }

    /// Finds newest models whose files are missing or, if `reads_all`, damaged. They no longer count. Returns what is wrong
    /// with each.
    pub(super) fn drop_lost(&mut self, reads_all: bool) -> Result<Vec<(ModelHeader, String)>, ServiceError> {
        let mut lost = Vec::new();
        for header in self.newest() {
            let key = ModelKey::from(&header);
            let fault = match (self.models.has(key), reads_all) {
                (false, _) => Some("its file is missing".to_owned()),
                (true, true) => self.models.get(key).err().map(|error| error.to_string()),
                (true, false) => None,
            };
            if let Some(fault) = fault {
                self.models.put_aside(key)?;
                self.stored.entry(header.device).or_default().remove(&header.model);
                lost.push((header, fault));
            }
        }
        Ok(lost)
    }

    /// Whether a model that was merged should be here and is not: it is neither replaced nor withdrawn.
    pub(super) fn lacks(&self, merged: &Input) -> Option<ModelKey> {
        let key = ModelKey { device: merged.device.parse().ok()?, model: ModelId(merged.model) };
        let is_listed = |listed: &ModelList, model| listed.has(model, &merged.blake3);
        let is_lacking = merged.part_splats.is_none() && self.lacks_model(key, is_listed);
        is_lacking.then_some(key)
    }

    /// Whether a model would count if it were here: there is no newer one of its device, and it is not withdrawn.
    fn lacks_model(&self, key: ModelKey, is_listed: impl Fn(&ModelList, ModelId) -> bool) -> bool {
        let stored = self.stored.get(&key.device);
        let has_newer = stored.is_some_and(|models| models.range(key.model..).next().is_some());
        !has_newer && !self.withdrawn.get(&key.device).is_some_and(|listed| is_listed(listed, key.model))
    }

    /// The models whose files were set aside at the start. Their devices must be asked for them.
    pub(super) fn take_damaged(&mut self) -> Vec<ModelKey> {
        std::mem::take(&mut self.damaged)
    }

    /// Adds all models that have been received from a device to the list of its withdrawn models.
    fn list_models(&mut self, device: DeviceId, listed: &mut ModelList) -> Result<(), SceneError> {
        listed.asks = false;
        if let Some(before) = self.withdrawn.get(&device) {
            listed.add_all(before);
        }
        listed.add_all(&ModelList::read(&self.folder.join(REPLACED), &device));
        self.stored.get(&device).into_iter().flat_map(BTreeMap::values).for_each(|header| listed.add(header));
        if let Some(part) = self.parts.model_of(&device) {
            listed.add_number(part);
        }
        listed.flights_until = Some(self.flights.withdraw(&device)).max(listed.flights_until);
        listed.write(&self.folder.join(WITHDRAWN), &device)?;
        self.to_void.push(device);
        Ok(())
    }

    /// Removes the listed models of a device. Returns whether there were any.
    fn withdraw(&mut self, device: DeviceId, listed: ModelList) -> Result<bool, ServiceError> {
        let has_part = self.parts.model_of(&device).is_some_and(|part| listed.has_part(part));
        if has_part {
            self.parts.forget(&device);
        }
        let is_listed = |header: &&ModelHeader| listed.has(header.model, &header.blake3.to_string());
        let stored = self.stored.get(&device).into_iter().flat_map(BTreeMap::values);
        let gone: Vec<ModelHeader> = stored.filter(is_listed).copied().collect();
        for header in &gone {
            self.models.remove(header.into())?;
            self.stored.entry(device).or_default().remove(&header.model);
            self.to_forget.push(header.into());
        }
        self.withdrawn.insert(device, listed);
        Ok(has_part || !gone.is_empty())
    }

    /// Models withdrawn since the last call. The link must forget them.
    pub(super) fn take_forgotten(&mut self) -> impl Iterator<Item = ModelKey> {
        self.to_forget.drain(..)
    }

    /// Notes that a device in its session `session` will send a model of its flight. Returns whether other flights are
    /// confirmed than before.
    pub(super) fn pledge(&mut self, device: DeviceId, session: u64, cameras_blake3: BodyHash) -> bool {
        let withdrawn = self.withdrawn.get(&device).and_then(|listed| listed.flights_until);
        self.flights.pledge(device, session, cameras_blake3, withdrawn)
    }

    /// The flights that count: devices, and the hashes of their cameras.
    pub(super) fn confirmed_flights(&self) -> Vec<(DeviceId, BodyHash)> {
        self.flights.list()
    }

    /// Devices withdrawn since the last call. Their announced flights must be deleted.
    pub(super) fn take_void_flights(&mut self) -> impl Iterator<Item = DeviceId> {
        self.to_void.drain(..)
    }
}

fn take_part(parts: &mut Parts, node: &mut Node, header: &ModelHeader) -> Option<ServiceEvent> {
    match parts.take(node, header) {
        Ok(part) => part.map(|part| ServiceEvent::PartTaken { header: part, of_splats: header.splats }),
        Err(error) => {
            let reason =
                format!("the part of the model of {} that has arrived is not used: {error}", header.device);
            Some(ServiceEvent::DiskFailed { reason })
        }
    }
}
