//! A global model on its way to the devices: whole to all of them, or in tiles. Each device gets the manifest and then its
//! tiles, one after the other.

use std::collections::{BTreeMap, VecDeque};

use cosurf_link::{Manifest, ModelKey, ModelStore, Node, Offer, TileEntry};
use cosurf_wire::{DeviceId, TileId};

use super::error::ServiceError;
use super::sent::{Form, Sent};

/// The tiles on their way, if a model is sent in tiles.
#[derive(Debug, Default)]
pub(super) struct Rebroadcast {
    /// Where the tiles are, who has made them, and which they are.
    tiles: Option<(ModelStore, DeviceId, Manifest)>,
    /// The tiles that each device has not been offered yet.
    queues: BTreeMap<DeviceId, VecDeque<ModelKey>>,
    /// Whether the devices do not all have the manifest yet.
    is_announcing: bool,
    /// Whether [`Self::send`] has still to tell that all devices have their tiles.
    is_running: bool,
}

impl Rebroadcast {
    /// Offers a model to these devices in place of the last one: all of it at once, or its manifest and then its tiles. Does
    /// nothing if the folder has no model.
    pub(super) fn begin(
        &mut self,
        node: &mut Node,
        sent: &Sent,
        receivers: &[DeviceId],
    ) -> Result<(), ServiceError> {
        let Some((header, form)) = sent.newest() else { return Ok(()) };
        let (header, body) = sent.store().get(header.into())?;
        self.begin_whole(node, Offer { header, body }, receivers);
        if let Form::Tiles(manifest) = form {
            let queue = |device: &DeviceId| (*device, tiles_of(manifest, header.device, *device));
            self.queues = receivers.iter().map(queue).collect();
            self.tiles = Some((sent.store().clone(), header.device, manifest.clone()));
            (self.is_announcing, self.is_running) = (true, true);
        }
        Ok(())
    }

    /// Offers a whole model to these devices in place of the last one.
    pub(super) fn begin_whole(&mut self, node: &mut Node, offer: Offer, receivers: &[DeviceId]) {
        self.stop(node);
        node.broadcast(TileId::WHOLE, offer, receivers);
    }

    /// Offers all its tiles again to a device that has lost the model.
    pub(super) fn again(&mut self, device: DeviceId) {
        if let Some((_, by, manifest)) = &self.tiles {
            self.queues.insert(device, tiles_of(manifest, *by, device));
            self.is_running = true;
        }
    }

    /// Stops sending tiles.
    pub(super) fn stop(&mut self, node: &mut Node) {
        node.stop_tiles();
        *self = Self::default();
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
        let Some((store, ..)) = self.tiles.as_ref().filter(|_| self.is_running) else { return Ok(false) };
        for (device, queue) in &mut self.queues {
            if node.is_sending_tile(*device) {
                continue;
            }
            if let Some(key) = queue.front() {
                let (header, body) = store.get(*key)?;
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

/// The tiles of a model, made by the device `by`, that a device gets.
fn tiles_of(manifest: &Manifest, by: DeviceId, device: DeviceId) -> VecDeque<ModelKey> {
    manifest.of(device).map(|tile: &TileEntry| ModelKey { device: by, model: tile.model }).collect()
}
