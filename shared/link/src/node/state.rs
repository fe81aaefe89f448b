//! The state of a node, and the calls that change it.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::path::Path;
use std::time::Duration;

use cosurf_scene::{Camera, LocalFrame};
use cosurf_wire::{
    BodyHash, DeviceId, FlightCameras, Message, ModelHeader, ModelId, RefusalReason, TileId, Topic,
};
use tracing::debug;

use super::asking::Asking;
use super::births::Births;
use super::confirm::Confirming;
use super::event::NodeEvent;
use super::flight::{camera_bytes, select_flight_cameras};
use super::log::Log;
use super::lost::Lost;
use super::planning::{PlannedCell, Planning};
use super::pledge::Pledge;
use crate::body::{Model, body_hash};
use crate::guard::Guard;
use crate::identity::{Identity, Role};
use crate::inbox::{Inbox, InboxLimits};
use crate::key::ModelKey;
use crate::offer::Offer;
use crate::sealing::Sealer;
use crate::store::StoreError;
use crate::transport::Outgoing;
use crate::trust::Credentials;
use crate::uploader::{DEVICES_MAX, Uploader};

/// A participant of the protocol: a device or an aggregator. Its caller runs it by calling [`Self::step`]
/// repeatedly.
#[derive(Debug)]
pub struct Node {
    pub(super) identity: Identity,
    pub(super) inbox: Inbox,
    pub(super) uploaders: Vec<Uploader>,
    pub(super) events: VecDeque<NodeEvent>,
    /// The notice that this session has started, while it waits to be sent. It is sent after each connection.
    pub(super) birth: Option<Outgoing>,
    /// The message with the cameras of this device's flight; `None` if the device does not announce them.
    pub(super) flight: Option<Outgoing>,
    pub(super) is_flight_due: bool,
    /// This device's pledge of its flight.
    pub(super) pledge: Option<Pledge>,
    /// Of an aggregator: the flights that it has confirmed.
    pub(super) confirming: Confirming,
    /// The plan of the site, for an aggregator that tells devices their cells; otherwise `None`.
    pub(super) planning: Option<Planning>,
    /// The question of a device for its cell of the plan; `None` if it does not ask.
    pub(super) asking: Option<Asking>,
    /// Topics whose retained messages are to be deleted.
    pub(super) cleared: VecDeque<Topic>,
    /// Refusals for devices of the version before.
    pub(super) refusals_before: VecDeque<Outgoing>,
    /// The sessions of other devices.
    pub(super) births: Births,
    pub(super) lost: Lost,
    /// Limit on the devices in `births`, and on the receivers of a global model that did not have to get it.
    pub(super) devices_max: usize,
    /// A control message that the transport has not accepted yet.
    pub(super) waiting_control: Option<Outgoing>,
    /// A chunk that the transport has not accepted yet. Control messages overtake it.
    pub(super) waiting_chunk: Option<Outgoing>,
    pub(super) sealer: Sealer,
    pub(super) guard: Guard,
    /// Number of messages that no listed key had signed.
    pub(super) forged: u64,
    pub(super) is_connected: bool,
    /// Devices whose messages are ignored, whoever has signed them.
    pub(super) revoked: BTreeSet<DeviceId>,
    pub(super) log: Log,
    pub(super) now: Duration,
}

impl Node {
    /// Makes a node. `stored` has the headers of the models that are already on disk, from
    /// [`crate::ModelStore::open`].
    pub fn new(identity: Identity, limits: InboxLimits, stored: &[ModelHeader]) -> Self {
        Self {
            identity,
            inbox: Inbox::new(identity, limits, stored),
            uploaders: Vec::new(),
            events: VecDeque::new(),
            birth: None,
            flight: None,
            is_flight_due: false,
            pledge: None,
            confirming: Confirming::default(),
            planning: None,
            asking: None,
            cleared: VecDeque::new(),
            refusals_before: VecDeque::new(),
            births: Births::default(),
            lost: Lost::default(),
            devices_max: DEVICES_MAX,
            waiting_control: None,
            waiting_chunk: None,
            sealer: Sealer::default(),
            guard: Guard::default(),
            forged: 0,
            is_connected: false,
            revoked: BTreeSet::new(),
            log: Log::default(),
            now: Duration::ZERO,
        }
    }

    /// Sets the world frame and the keys of this node. The node then sends models in that frame, and signs its messages if
    /// it has a secret key. It accepts only models in the same frame and, if it has a list of keys, only messages that a
    /// listed key has signed. It answers other messages with silence.
    pub fn set_credentials(&mut self, credentials: Credentials) {
        self.inbox.set_credentials(credentials);
    }

    /// Ignores all messages of these devices from now on, whoever has signed them, and drops what has arrived of their
    /// uploads. Replaces the devices that were given before.
    pub fn revoke(&mut self, devices: BTreeSet<DeviceId>) {
        self.inbox.drop_uploads_of(&devices);
        self.revoked = devices;
    }

    /// Sets the limit on devices: the sessions of so many are remembered, and the requests of so many for a global
    /// model are answered, [`DEVICES_MAX`] if it is not set. Receivers that a global model must reach are always answered.
    pub fn set_devices_max(&mut self, devices_max: usize) {
        self.devices_max = devices_max;
    }

    /// Announces this device's flight to other devices. The message has the cameras that
    /// [`select_flight_cameras`] selects.
    pub fn announce_flight(&mut self, cameras: &[Camera]) {
        let device = self.identity.device;
        let bytes = camera_bytes(&select_flight_cameras(cameras));
        let flight = FlightCameras { device, frame: self.inbox.credentials().frame, cameras: &bytes };
        let message = Message::Flight(flight);
        self.flight = Some(Outgoing::new(&self.identity.site, Topic::Flight { device }, &message, true));
        self.is_flight_due = self.is_connected;
        if self.is_connected && self.pledges_flights() {
            // The aggregator answers with its list, which tells the session to pledge to.
            self.birth = Some(self.identity.state_message(true));
        }
        self.pledge = Some(Pledge::new(device, body_hash(&bytes)));
    }

    /// Of an aggregator: tells all devices which flights count, here those of [`NodeEvent::FlightPledged`] that the caller
    /// goes by. Without a key and a list of trusted keys, nothing is told.
    pub fn confirm_flights(&mut self, flights: Vec<(DeviceId, BodyHash)>) {
        self.confirming.set(flights);
    }

    /// Makes an aggregator answer the start of each device's session: it tells the device its cell of this plan, or that it
    /// has none.
    pub fn share_plan(&mut self, cells: BTreeMap<DeviceId, PlannedCell>) {
        self.planning = Some(Planning::new(cells));
    }

    /// Makes a device ask the aggregator for its cell of the site's plan, as soon as it is connected. The answer comes as
    /// [`NodeEvent::Plan`]. To be called before the device connects.
    pub fn ask_for_plan(&mut self) {
        self.asking = Some(Asking::default());
    }

    /// Whether this node confirms flights: without keys, nobody could tell whose word it is.
    pub(super) fn confirms_flights(&self) -> bool {
        let credentials = self.inbox.credentials();
        self.identity.role == Role::Aggregator && credentials.key.is_some() && credentials.trusted.is_some()
    }

    /// Whether this device pledges its flight and believes lists of confirmed flights: only if it knows the aggregator's key.
    pub(super) fn pledges_flights(&self) -> bool {
        self.identity.role == Role::Device && self.inbox.credentials().trusted.is_some()
    }

    /// Deletes the announced flight of `device` from the broker. Devices that connect later do not receive it.
    pub fn clear_flight(&mut self, device: DeviceId) {
        self.cleared.push_back(Topic::Flight { device });
    }

    /// Offers a device's own model to the aggregator. An unfinished offer of the same model is replaced.
    pub fn upload(&mut self, offer: Offer) {
        debug!(model = %ModelKey::from(offer.header), bytes = offer.header.body_bytes, "upload");
        let offer = offer.in_frame(self.inbox.credentials().frame);
        let uploader = Uploader::local(self.identity.site, offer);
        self.uploaders.retain(|old| old.key() != uploader.key() && !old.is_kept());
        self.add_uploader(uploader);
    }

    /// Offers a device's own model under another number, after the aggregator has refused it because it has one under this
    /// number or a higher one. Returns the number; `None` if the model is no longer offered or was given too many.
    pub fn renumber(&mut self, key: ModelKey) -> Option<ModelId> {
        let now = self.now;
        let uploader = self.uploaders.iter_mut().find(|uploader| uploader.key() == key)?;
        let next = uploader.renumber(now, self.identity.session)?;
        debug!(model = %key, to = %next, "another number");
        self.cleared.push_back(Topic::LocalHeader { device: key.device, model: key.model });
        Some(next)
    }

    /// Offers the global model of a tile to all devices, in place of the tile's previous model. The event
    /// [`NodeEvent::Uploaded`] follows when all `receivers` have stored the model.
    pub fn broadcast(&mut self, tile: TileId, offer: Offer, receivers: &[DeviceId]) {
        debug!(model = %ModelKey::from(offer.header), receivers = receivers.len(), "broadcast");
        self.uploaders.retain(|old| old.tile() != Some(tile));
        let offer = offer.in_frame(self.inbox.credentials().frame);
        let uploader = Uploader::global(self.identity.site, tile, offer, receivers);
        self.add_uploader(uploader.with_peers_max(self.devices_max));
    }

    /// Offers a tile of the global model to one device. [`NodeEvent::Uploaded`] follows when the device has stored it.
    pub fn send_tile(&mut self, device: DeviceId, offer: Offer) {
        debug!(model = %ModelKey::from(offer.header), %device, "send a tile");
        let offer = offer.in_frame(self.inbox.credentials().frame);
        self.add_uploader(Uploader::tile_for(self.identity.site, device, offer));
    }

    fn add_uploader(&mut self, uploader: Uploader) {
        let signs = self.inbox.credentials().key.is_some();
        self.uploaders.push(if signs { uploader } else { uploader.unsigned() });
    }

    /// Whether a tile is being sent to a device.
    pub fn is_sending_tile(&self, device: DeviceId) -> bool {
        self.uploaders.iter().any(|uploader| uploader.device() == Some(device) && !uploader.is_over())
    }

    /// Stops sending tiles.
    pub fn stop_tiles(&mut self) {
        self.uploaders.retain(|uploader| uploader.device().is_none());
    }

    /// Accepts these tiles of the global model from now on, and no others.
    pub fn expect_tiles(&mut self, tiles: BTreeMap<ModelKey, BodyHash>) {
        self.inbox.expect_tiles(tiles);
    }

    /// Stops offering the global model of a tile, and deletes its announcement from the broker.
    pub fn withdraw_global(&mut self, tile: TileId) {
        debug!("withdraw the global model");
        self.uploaders.retain(|old| old.tile() != Some(tile));
        self.cleared.push_back(Topic::GlobalHeader { tile });
    }

    /// Call this when the body of [`NodeEvent::Store`] is on disk, synced and renamed.
    pub fn stored(&mut self, key: ModelKey) {
        debug!(model = %key, "stored");
        self.inbox.stored(key);
    }

    /// Forgets that a model was stored. It is received again if it is offered again.
    pub fn forget(&mut self, key: ModelKey) {
        debug!(model = %key, "forgotten");
        self.inbox.forget(key);
        self.lost.found(key);
    }

    /// Asks the sender of a model that was stored and is lost for it, until it is offered again.
    pub fn ask_again(&mut self, key: ModelKey) {
        debug!(model = %key, "ask again");
        self.inbox.forget(key);
        self.lost.add(self.now, key);
    }

    /// Call this when storing failed and a retry may succeed, for example on a full disk. The node hands out
    /// the body again later.
    pub fn store_failed(&mut self, key: ModelKey) {
        debug!(model = %key, "storing failed");
        self.inbox.store_failed(self.now, key);
    }

    /// Drops an unfinished model, and sends `reason` to the model's sender.
    pub fn refuse(&mut self, key: ModelKey, reason: RefusalReason) {
        debug!(model = %key, %reason, "refuse");
        self.inbox.refuse(key, reason);
    }

    /// Number of messages that were dropped because no listed key of their sender had signed them.
    pub fn forged(&self) -> u64 {
        self.forged
    }

    /// Bytes that the bodies take which are being received or stored, at most [`InboxLimits::total_bytes_max`].
    pub fn unfinished_bytes(&self) -> u64 {
        self.inbox.unfinished_bytes()
    }

    /// Keeps what arrives of unfinished models in a folder, so that it outlasts a restart. See [`Inbox::keep_arrived`].
    pub fn keep_arrived(&mut self, folder: &Path) -> Result<(), StoreError> {
        self.inbox.keep_arrived(folder)
    }

    /// Headers of the models of which only a part is here. See [`Inbox::unfinished`].
    pub fn unfinished(&self) -> impl Iterator<Item = &ModelHeader> {
        self.inbox.unfinished()
    }

    /// Decodes the packs of an unfinished model that have arrived. See [`Inbox::part`].
    pub fn part(&mut self, key: ModelKey) -> Option<(LocalFrame, Model)> {
        self.inbox.part(key)
    }
}
