//! The tiles of a global model that is too large to be sent whole: on disk, and on their way to the devices. Each device
//! gets the manifest and then its tiles, one after the other. A tile that has not changed keeps its number, so a device
//! that has it does not fetch it again.

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::path::Path;

use cosurf_link::{Manifest, ModelKey, ModelStore, Node, Offer, Receiver, TileEntry};
use cosurf_wire::{BodyHash, DeviceId, ModelHeader, ModelId, ModelKind, TileId};

use super::cut::Cut;
use super::error::ServiceError;

/// The tiles of the newest revision. There are none if it was sent whole.
#[derive(Debug)]
pub(super) struct Rebroadcast {
    store: ModelStore,
    manifest: Option<(ModelHeader, Manifest)>,
    /// The tiles that each device has not been offered yet.
    queues: BTreeMap<DeviceId, VecDeque<ModelKey>>,
    /// Whether the devices do not all have the manifest yet.
    is_announcing: bool,
    /// Whether [`Self::send`] has still to tell that all devices have their tiles.
    is_running: bool,
}

impl Rebroadcast {
    /// Opens the folder of the tiles.
    pub(super) fn open(folder: &Path) -> Result<Self, ServiceError> {
        let (store, headers) = ModelStore::open(folder)?;
        let manifests = headers.iter().filter(|header| header.kind == ModelKind::Manifest);
        let newest = manifests.max_by_key(|header| header.model);
        let read = |header: &ModelHeader| -> Result<_, ServiceError> {
            let (header, body) = store.get(header.into())?;
            Ok((header, Manifest::decode(&body)?))
        };
        let manifest = newest.map(read).transpose()?;
        Ok(Self { store, manifest, queues: BTreeMap::new(), is_announcing: false, is_running: false })
    }

    /// Number of the newest manifest.
    pub(super) fn newest(&self) -> Option<ModelId> {
        self.manifest.as_ref().map(|(header, _)| header.model)
    }

    /// Writes the tiles of a new revision to the disk. If they and their receivers are those of the newest, that one
    /// stays.
    pub(super) fn keep(
        &mut self,
        device: DeviceId,
        revision: ModelId,
        views: u32,
        cut: Cut,
    ) -> Result<(), ServiceError> {
        let old = self.manifest.take();
        let known: HashMap<BodyHash, ModelId> = old
            .iter()
            .flat_map(|(_, manifest)| manifest.tiles.iter().map(|tile| (tile.blake3, tile.model)))
            .collect();
        let mut tiles = Vec::with_capacity(cut.bodies.len());
        for (index, body) in cut.bodies.into_iter().enumerate() {
            let offer =
                Offer::from_body(device, ModelId::of_tile(revision, index), ModelKind::Global, 0, body)?;
            let mut header = offer.header;
            match known.get(&header.blake3) {
                Some(number) => header.model = *number,
                None => self.store.put(&header, &offer.body)?,
            }
            tiles.push(TileEntry {
                model: header.model,
                blake3: header.blake3,
                splats: header.splats,
                body_bytes: header.body_bytes,
                bounds: header.bounds,
            });
        }
        let receivers = cut.receivers.into_iter().map(|(device, tiles)| Receiver { device, tiles }).collect();
        let manifest = Manifest { tiles, receivers };
        let header = match old {
            Some((header, old)) if old == manifest => header,
            _ => {
                let offer = Offer::of_manifest(device, revision, views, &manifest)?;
                self.store.put(&offer.header, &offer.body)?;
                offer.header
            }
        };
        let numbers = manifest.tiles.iter().map(|tile| tile.model);
        let needed: BTreeSet<ModelId> = numbers.chain([header.model]).collect();
        self.manifest = Some((header, manifest));
        self.remove_all_but(&needed)
    }

    /// Removes the tiles: the newest revision is sent whole, or there is none any more.
    pub(super) fn clear(&mut self, node: &mut Node) -> Result<(), ServiceError> {
        node.stop_tiles();
        self.manifest = None;
        self.queues.clear();
        (self.is_announcing, self.is_running) = (false, false);
        self.remove_all_but(&BTreeSet::new())
    }

    fn remove_all_but(&self, needed: &BTreeSet<ModelId>) -> Result<(), ServiceError> {
        for key in self.store.keys()? {
            if !needed.contains(&key.model) {
                self.store.remove(key)?;
            }
        }
        Ok(())
    }

    /// Begins to send the manifest and the tiles to these devices. Returns the header of the manifest; `None` if the
    /// newest revision is sent whole.
    pub(super) fn begin(
        &mut self,
        node: &mut Node,
        receivers: &[DeviceId],
    ) -> Result<Option<ModelHeader>, ServiceError> {
        let Some((header, manifest)) = &self.manifest else { return Ok(None) };
        let (header, body) = self.store.get(header.into())?;
        node.stop_tiles();
        node.broadcast(TileId::WHOLE, Offer { header, body }, receivers);
        let key = |tile: &TileEntry| ModelKey { device: header.device, model: tile.model };
        let queue = |device: &DeviceId| (*device, manifest.of(*device).map(key).collect());
        self.queues = receivers.iter().map(queue).collect();
        (self.is_announcing, self.is_running) = (true, true);
        Ok(Some(header))
    }

    /// Notes that all devices have the manifest.
    pub(super) fn announced(&mut self) {
        self.is_announcing = false;
    }

    /// Whether tiles or their manifest are on their way.
    pub(super) fn is_running(&self) -> bool {
        self.is_running
    }

    /// Offers each device that has all tiles offered so far its next one. Returns true once, when all devices have all
    /// their tiles.
    pub(super) fn send(&mut self, node: &mut Node) -> Result<bool, ServiceError> {
        if !self.is_running {
            return Ok(false);
        }
        for (device, queue) in &mut self.queues {
            if node.is_sending_tile(*device) {
                continue;
            }
            if let Some(key) = queue.front() {
                let (header, body) = self.store.get(*key)?;
                node.send_tile(*device, Offer { header, body });
                queue.pop_front();
            }
        }
        let is_sent =
            |(device, queue): (&DeviceId, &VecDeque<_>)| queue.is_empty() && !node.is_sending_tile(*device);
        let is_over = !self.is_announcing && self.queues.iter().all(is_sent);
        self.is_running = !is_over;
        Ok(is_over)
    }
}
