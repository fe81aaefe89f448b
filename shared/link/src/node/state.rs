//! The state of a node, and the calls by which its user changes it.

use std::collections::VecDeque;
use std::time::Duration;

use cosurf_scene::Camera;
use cosurf_wire::{DeviceId, Flight, Message, ModelHeader, RefusalReason, TileId, Topic};

use super::births::Births;
use super::event::NodeEvent;
use super::flight::{camera_bytes, told_cameras};
use crate::body::Model;
use crate::identity::Identity;
use crate::inbox::{Inbox, InboxLimits};
use crate::key::ModelKey;
use crate::offer::Offer;
use crate::transport::Outgoing;
use crate::trust::Credentials;
use crate::uploader::Uploader;

/// A participant. Give it a transport and the time, again and again.
#[derive(Debug)]
pub struct Node {
    pub(super) identity: Identity,
    pub(super) inbox: Inbox,
    pub(super) uploaders: Vec<Uploader>,
    pub(super) events: VecDeque<NodeEvent>,
    /// The birth notice, due after each connection.
    pub(super) birth: Option<Outgoing>,
    /// What this device has photographed, if it tells that.
    pub(super) flight: Option<Outgoing>,
    pub(super) is_flight_due: bool,
    /// Flights of others that do not count any more, to be taken back.
    pub(super) void_flights: VecDeque<DeviceId>,
    /// The sessions that other devices have started.
    pub(super) births: Births,
    /// Handed out by a machine, not yet taken by the transport.
    pub(super) pending: Option<Outgoing>,
    pub(super) is_connected: bool,
    pub(super) now: Duration,
}

impl Node {
    /// A node that holds the models of `stored` already (their headers, as [`crate::ModelStore::open`] gives).
    pub fn new(identity: Identity, limits: InboxLimits, stored: &[ModelHeader]) -> Self {
        Self {
            identity,
            inbox: Inbox::new(identity, limits, stored),
            uploaders: Vec::new(),
            events: VecDeque::new(),
            birth: None,
            flight: None,
            is_flight_due: false,
            void_flights: VecDeque::new(),
            births: Births::default(),
            pending: None,
            is_connected: false,
            now: Duration::ZERO,
        }
    }

    /// From now on sends models in the frame of `credentials` and signed by their key, and takes only such as
    /// they believe.
    pub fn believe(&mut self, credentials: Credentials) {
        self.inbox.believe(credentials);
    }

    /// From now on tells other devices what this one has photographed: [`told_cameras`].
    pub fn tell_flight(&mut self, cameras: &[Camera]) {
        let device = self.identity.device;
        let bytes = camera_bytes(&told_cameras(cameras));
        let flight = Flight { device, frame: self.inbox.credentials().frame, cameras: &bytes };
        let message = Message::Flight(flight);
        self.flight = Some(Outgoing::new(&self.identity.site, Topic::Flight { device }, &message, true));
        self.is_flight_due = self.is_connected;
    }

    /// Takes back what a device has told of its flight, for nobody must leave ground to it any more.
    pub fn void_flight(&mut self, device: DeviceId) {
        self.void_flights.push_back(device);
    }

    /// Begins to offer a device's own model to the aggregator. An offer of the same model that is under
    /// way is replaced.
    pub fn upload(&mut self, offer: Offer) {
        let offer = offer.with(&self.identity.site, self.inbox.credentials());
        let uploader = Uploader::local(self.identity.site, offer);
        self.uploaders.retain(|old| old.key() != uploader.key());
        self.uploaders.push(uploader);
    }

    /// Begins to offer a global model to all devices, in place of any older revision, and waits for
    /// `receivers`.
    pub fn broadcast(&mut self, tile: TileId, offer: Offer, receivers: &[DeviceId]) {
        self.uploaders.retain(|old| old.tile() != Some(tile));
        let offer = offer.with(&self.identity.site, self.inbox.credentials());
        self.uploaders.push(Uploader::global(self.identity.site, tile, offer, receivers));
    }

    /// The body that [`NodeEvent::Store`] handed out is on the disk, synced and renamed.
    pub fn stored(&mut self, key: ModelKey) {
        self.inbox.stored(key);
    }

    /// It is not, and may be tried again (disk full): it is handed out again after a while.
    pub fn store_failed(&mut self, key: ModelKey) {
        self.inbox.store_failed(self.now, key);
    }

    /// It is not wanted.
    pub fn refuse(&mut self, key: ModelKey, reason: RefusalReason) {
        self.inbox.refuse(key, reason);
    }

    /// Bytes of models on their way in; never more than the limits allow.
    pub fn unfinished_bytes(&self) -> u64 {
        self.inbox.unfinished_bytes()
    }

    /// Models whose chunks have not all come.
    pub fn unfinished(&self) -> impl Iterator<Item = &ModelHeader> {
        self.inbox.unfinished()
    }

    /// What has come of an unfinished model: [`Inbox::part`].
    pub fn part(&self, key: ModelKey) -> Option<Model> {
        self.inbox.part(key)
    }
}
