//! A participant: its inbox, its uploads and its birth notice, on one transport. What it sends is here, what it hears in
//! [`hear`].

mod event;
mod flight;
mod hear;
mod upload;

pub use event::NodeEvent;
pub use flight::told_cameras;
pub use upload::{UploadFault, upload_blocking};

use std::collections::{BTreeMap, VecDeque};
use std::ops::ControlFlow;
use std::time::Duration;

use cosurf_scene::Camera;
use cosurf_wire::{DeviceId, Flight, Message, ModelHeader, RefusalReason, TileId, Topic};

use crate::body::Model;
use crate::identity::Identity;
use crate::inbox::{Inbox, InboxAction, InboxLimits};
use crate::key::ModelKey;
use crate::offer::Offer;
use crate::transport::{Outgoing, PublishError, Transport};
use crate::trust::Credentials;
use crate::uploader::Uploader;
use hear::Sessions;

/// Messages sent between two looks at what has come in. Ours: half a window.
const BURST: usize = 16;
/// How soon a busy transport is tried again.
const BUSY_WAIT: Duration = Duration::from_millis(2);

/// A participant. Give it a transport and the time, again and again.
#[derive(Debug)]
pub struct Node {
    identity: Identity,
    inbox: Inbox,
    uploaders: Vec<Uploader>,
    events: VecDeque<NodeEvent>,
    /// The birth notice, due after each connection.
    birth: Option<Outgoing>,
    /// What this device has photographed, if it tells that.
    flight: Option<Outgoing>,
    is_flight_due: bool,
    /// Flights of others that do not count any more, to be taken back.
    void_flights: VecDeque<DeviceId>,
    /// The sessions of each device that was born; at most [`hear::DEVICES_MAX`].
    sessions: BTreeMap<DeviceId, Sessions>,
    /// Handed out by a machine, not yet taken by the transport.
    pending: Option<Outgoing>,
    is_connected: bool,
    now: Duration,
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
            sessions: BTreeMap::new(),
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
        let bytes = flight::camera_bytes(&told_cameras(cameras));
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

    /// Hears, answers and sends what there is, waiting at most `wait` for something to hear. Returns what
    /// the owner must know; `None` says nothing about whether more is to be done.
    pub fn step<T: Transport>(
        &mut self,
        transport: &mut T,
        now: impl Fn() -> Duration,
        wait: Duration,
    ) -> Option<NodeEvent> {
        self.now = now();
        if let Some(event) = self.events.pop_front() {
            return Some(event);
        }
        let wait = wait.min(self.send(transport));
        if let Some(event) = self.events.pop_front() {
            return Some(event);
        }
        if let Some(event) = transport.poll(wait) {
            self.now = now();
            self.hear(event);
        }
        self.events.pop_front()
    }

    /// Calls [`Self::step`] until `on_event` breaks; it is called with `None` at least every `wait`.
    pub fn serve<T: Transport, B>(
        &mut self,
        transport: &mut T,
        now: impl Fn() -> Duration,
        wait: Duration,
        mut on_event: impl FnMut(&mut Self, Option<NodeEvent>) -> ControlFlow<B>,
    ) -> B {
        loop {
            let event = self.step(transport, &now, wait);
            if let ControlFlow::Break(result) = on_event(self, event) {
                return result;
            }
        }
    }

    /// When [`Self::step`] has something to do although nothing is heard.
    pub fn next_wakeup(&self) -> Option<Duration> {
        let uploads = self.uploaders.iter().filter_map(Uploader::next_wakeup);
        uploads.chain(self.inbox.next_wakeup()).min().filter(|_| self.is_connected)
    }

    /// Sends what is due, up to [`BURST`]; returns how long there is nothing more to send.
    fn send<T: Transport>(&mut self, transport: &mut T) -> Duration {
        if !self.is_connected {
            return Duration::MAX;
        }
        for _ in 0..BURST {
            let Some(message) = self
                .pending
                .take()
                .or_else(|| self.birth.take())
                .or_else(|| self.next_flight())
                .or_else(|| self.next_outgoing())
            else {
                let wakeup = self.next_wakeup().unwrap_or(Duration::MAX);
                return wakeup.saturating_sub(self.now);
            };
            match transport.publish(&message) {
                Ok(()) => {}
                Err(PublishError::Busy) => {
                    self.pending = Some(message);
                    return BUSY_WAIT;
                }
                Err(error @ PublishError::TooLarge { max_bytes, .. }) => self.on_too_large(error, max_bytes),
            }
        }
        Duration::ZERO
    }

    fn next_flight(&mut self) -> Option<Outgoing> {
        if let Some(device) = self.void_flights.pop_front() {
            return Some(Outgoing::clear(&self.identity.site, Topic::Flight { device }));
        }
        std::mem::take(&mut self.is_flight_due).then(|| self.flight.clone()).flatten()
    }

    fn next_outgoing(&mut self) -> Option<Outgoing> {
        while let Some(action) = self.inbox.next(self.now) {
            match action {
                InboxAction::Publish(message) => return Some(message),
                InboxAction::Store { header, body } => {
                    self.events.push_back(NodeEvent::Store { header, body });
                }
            }
        }
        let now = self.now;
        let message = self.uploaders.iter_mut().find_map(|uploader| uploader.next(now));
        self.uploaders.retain(|uploader| !uploader.is_over());
        message
    }

    /// Only chunks are ever too large: all offers go out again in smaller ones.
    fn on_too_large(&mut self, error: PublishError, max_bytes: usize) {
        let now = self.now;
        let before = self.uploaders.len();
        self.uploaders.retain_mut(|uploader| uploader.shrink_chunks(now, max_bytes));
        if self.uploaders.len() < before || before == 0 {
            self.events.push_back(NodeEvent::LinkTooNarrow(error));
        }
    }
}
