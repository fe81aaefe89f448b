//! A participant: its inbox, its uploads and its birth notice, on one transport.

use std::collections::{BTreeMap, VecDeque};
use std::ops::ControlFlow;
use std::sync::Arc;
use std::time::Duration;

use cosurf_scene::Camera;
use cosurf_wire::body::CAMERA_BYTES;
use cosurf_wire::{
    DeviceId, FLIGHT_CAMERAS_MAX, Flight, Message, ModelHeader, RefusalReason, SiteId, State, TileId, Topic,
    TopicString, WireError,
};

use crate::body::{camera, camera_record};
use crate::inbox::{Inbox, InboxAction, InboxEvent, InboxLimits};
use crate::transport::{Outgoing, PublishError, Transport, TransportEvent};
use crate::uploader::{UploadEvent, UploadProgress, Uploader};
use crate::{Credentials, Model, ModelKey, Offer};

/// Messages sent between two looks at what has come in. Ours: half a window.
const BURST: usize = 16;
/// Devices whose sessions are remembered.
const DEVICES_MAX: usize = 1024;
/// Births of an older session after a newer one that make two participants of one.
const RETURNS_MAX: u32 = 3;
/// How soon a busy transport is tried again.
const BUSY_WAIT: Duration = Duration::from_millis(2);

/// Who takes part.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Identity {
    /// In which site.
    pub site: SiteId,
    /// Under which name; two at once under one name throw each other out.
    pub device: DeviceId,
    /// Number of this session, greater than any before: [`crate::next_session`].
    pub session: u64,
    /// On which side.
    pub role: Role,
}

/// On which side.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// Sends local models, receives global ones.
    Device,
    /// Receives local models, sends global ones.
    Aggregator,
}

impl Identity {
    /// What this participant listens to, with MQTT's wildcards.
    pub fn filters(&self) -> Vec<TopicString> {
        match self.role {
            Role::Device => Topic::device_filters(&self.site, &self.device).to_vec(),
            Role::Aggregator => Topic::aggregator_filters(&self.site).to_vec(),
        }
    }

    /// Its birth, or its death, as a retained message.
    pub fn state_message(&self, alive: bool) -> Outgoing {
        let state = State { device: self.device, session: self.session, alive };
        Outgoing::new(&self.site, Topic::State { device: self.device }, &Message::State(state), true)
    }
}

/// What a node tells its owner.
#[derive(Clone, Debug)]
pub enum NodeEvent {
    /// The transport is connected (again).
    Connected,
    /// The transport is not connected and tries again.
    Disconnected {
        /// Failed attempts since it last stood, from 1.
        attempt: u32,
        /// One line to show.
        reason: String,
    },
    /// A device is born or has died.
    State(State),
    /// What another device has photographed, in this one's frame.
    Flight(DeviceId, Vec<Camera>),
    /// Two participants take turns under one name; each throws the other out.
    SameName(DeviceId),
    /// A header was accepted; its body is being fetched.
    Receiving(ModelHeader),
    /// A model was announced that is stored already, in this session or an earlier one.
    Known(ModelHeader),
    /// A whole, verified body. Write it, sync it, rename it, then call [`Node::stored`]; or
    /// [`Node::store_failed`], or [`Node::refuse`]. Until then its sender waits.
    Store {
        /// What was announced, and holds.
        header: ModelHeader,
        /// For [`crate::body_to_model`].
        body: Arc<Vec<u8>>,
    },
    /// A model from outside was refused; its sender has been told.
    Refused {
        /// Which.
        key: ModelKey,
        /// Why.
        reason: RefusalReason,
    },
    /// Something was heard and thrown away; worth a line in a log.
    Ignored {
        /// Under which topic.
        topic: String,
        /// Why.
        reason: String,
    },
    /// An upload got on.
    Progress(ModelKey, UploadProgress),
    /// Every receiver that is waited for has the model on its disk.
    Uploaded(ModelKey, UploadProgress),
    /// A receiver refuses the model; for good, unless the reason [`RefusalReason::is_passing`].
    UploadRefused {
        /// Which model.
        key: ModelKey,
        /// Who refuses: a device, or (for a local model) the aggregator, named as the model's own device.
        by: DeviceId,
        /// Why.
        reason: RefusalReason,
    },
    /// The link takes no messages of a size that makes sense.
    LinkTooNarrow(PublishError),
}

/// What is known of a device's births.
#[derive(Clone, Copy, Debug, Default)]
struct Sessions {
    newest: u64,
    /// Times that an older session was born after the newest: once or twice a broker repeats what is past.
    returns: u32,
}

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
    /// The sessions of each device that was born; at most [`DEVICES_MAX`].
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

    fn hear(&mut self, event: TransportEvent) {
        match event {
            TransportEvent::Connected => {
                self.is_connected = true;
                self.birth = Some(self.identity.state_message(true));
                self.is_flight_due = true;
                let now = self.now;
                self.uploaders.iter_mut().for_each(|uploader| uploader.on_connected(now));
                self.events.push_back(NodeEvent::Connected);
            }
            TransportEvent::Disconnected { attempt, reason } => {
                self.is_connected = false;
                self.events.push_back(NodeEvent::Disconnected { attempt, reason });
            }
            TransportEvent::Incoming { topic, payload } => {
                if let Err(reason) = self.hear_message(&topic, &payload) {
                    self.events.push_back(NodeEvent::Ignored { topic, reason });
                }
            }
        }
    }

    /// `Err` says why the message was thrown away.
    fn hear_message(&mut self, topic: &str, payload: &[u8]) -> Result<(), String> {
        let (site, topic) = Topic::parse(topic).map_err(|error| error.to_string())?;
        if site != self.identity.site {
            return Err(format!("belongs to site {site}"));
        }
        if payload.is_empty() {
            // Somebody took back what was retained.
            return Ok(());
        }
        let is_header = matches!(topic, Topic::LocalHeader { .. } | Topic::GlobalHeader { .. });
        let message = match Message::decode(payload) {
            Ok(message) => message,
            Err(error) => {
                let is_refusable = is_header && error != WireError::Damaged;
                let event = is_refusable.then(|| self.inbox.on_bad_header(&topic)).flatten();
                self.note_inbox(event);
                return Err(error.to_string());
            }
        };
        match (topic, &message) {
            (Topic::State { device }, Message::State(state)) if state.device == device => {
                self.hear_state(*state);
            }
            (Topic::Flight { device }, Message::Flight(flight)) if flight.device == device => {
                self.hear_flight(flight)?;
            }
            (Topic::LocalHeader { .. } | Topic::GlobalHeader { .. }, Message::Header(header)) => {
                let event = self.inbox.on_header(self.now, &topic, *header);
                self.note_inbox(event);
            }
            (Topic::LocalChunk { .. } | Topic::GlobalChunk { .. }, Message::Chunk(chunk)) => {
                let event = self.inbox.on_chunk(self.now, &topic, chunk);
                self.note_inbox(event);
                if let Some(InboxEvent::BadChunk(key, index)) = event {
                    return Err(format!("chunk {index} of {key} is not as announced"));
                }
            }
            (
                Topic::LocalReply { .. } | Topic::GlobalReply { .. },
                Message::Want(_) | Message::Done(_) | Message::Refused(_),
            ) => self.hear_reply(&topic, &message),
            _ => return Err("the message does not belong under its topic".to_owned()),
        }
        Ok(())
    }

    /// Flights are not signed: who believes some only believes none of them.
    fn hear_flight(&mut self, flight: &Flight<'_>) -> Result<(), String> {
        let Credentials { frame, trusted, .. } = self.inbox.credentials();
        if flight.device == self.identity.device || self.identity.role != Role::Device {
            return Ok(());
        }
        if trusted.is_some() {
            return Err("flights are not signed, and only what is signed is believed".to_owned());
        }
        if flight.frame != *frame {
            return Err("is in another world frame".to_owned());
        }
        let cameras = flight.records().map(|record| camera(&record)).collect();
        self.events.push_back(NodeEvent::Flight(flight.device, cameras));
        Ok(())
    }

    /// A death of an earlier session than the newest birth is out of date: the broker published it late.
    fn hear_state(&mut self, state: State) {
        let known = self.sessions.get(&state.device).copied();
        let is_past = known.is_some_and(|known| known.newest > state.session);
        if !state.alive && is_past {
            return;
        }
        if self.sessions.len() < DEVICES_MAX || known.is_some() {
            let Sessions { newest, returns } = known.unwrap_or_default();
            let returns = returns + u32::from(is_past);
            if is_past && returns == RETURNS_MAX {
                self.events.push_back(NodeEvent::SameName(state.device));
            }
            self.sessions.insert(state.device, Sessions { newest: newest.max(state.session), returns });
        }
        self.events.push_back(NodeEvent::State(state));
    }

    fn hear_reply(&mut self, topic: &Topic, message: &Message<'_>) {
        for uploader in &mut self.uploaders {
            let Some(event) = uploader.hear(self.now, topic, message) else { continue };
            let (key, progress) = (uploader.key(), uploader.progress());
            self.events.push_back(match event {
                UploadEvent::Progress => NodeEvent::Progress(key, progress),
                UploadEvent::Finished => NodeEvent::Uploaded(key, progress),
                UploadEvent::Refused(by, reason) => NodeEvent::UploadRefused { key, by, reason },
            });
        }
    }

    fn note_inbox(&mut self, event: Option<InboxEvent>) {
        match event {
            Some(InboxEvent::Receiving(header)) => self.events.push_back(NodeEvent::Receiving(header)),
            Some(InboxEvent::Known(header)) => self.events.push_back(NodeEvent::Known(header)),
            Some(InboxEvent::Refused(key, reason)) => {
                self.events.push_back(NodeEvent::Refused { key, reason });
            }
            Some(InboxEvent::BadChunk(..)) | None => {}
        }
    }
}

/// The cameras that a flight tells: all, or as many as it may, evenly spread.
pub fn told_cameras(cameras: &[Camera]) -> Vec<Camera> {
    let count = cameras.len().min(FLIGHT_CAMERAS_MAX);
    (0..count).map(|i| cameras[i * cameras.len() / count]).collect()
}

fn camera_bytes(cameras: &[Camera]) -> Vec<u8> {
    let mut bytes = vec![0; cameras.len() * CAMERA_BYTES];
    for (camera, out) in cameras.iter().zip(bytes.as_chunks_mut().0) {
        camera_record(camera).encode(out);
    }
    bytes
}

/// Uploads one model and returns when the aggregator has it on its disk, or why it refuses for good.
/// Everything else that happens is told to `on_event`, which must answer [`NodeEvent::Store`].
pub fn upload_blocking<T: Transport>(
    node: &mut Node,
    transport: &mut T,
    offer: Offer,
    now: impl Fn() -> Duration,
    mut on_event: impl FnMut(&mut Node, NodeEvent),
) -> Result<UploadProgress, UploadFault> {
    let mine = ModelKey::from(offer.header);
    node.upload(offer);
    node.serve(transport, now, Duration::from_secs(1), |node, event| match event {
        Some(NodeEvent::Uploaded(key, progress)) if key == mine => ControlFlow::Break(Ok(progress)),
        Some(NodeEvent::UploadRefused { key, reason, .. }) if key == mine && !reason.is_passing() => {
            ControlFlow::Break(Err(UploadFault::Refused(reason)))
        }
        Some(NodeEvent::LinkTooNarrow(error)) => ControlFlow::Break(Err(UploadFault::LinkTooNarrow(error))),
        Some(event) => {
            on_event(node, event);
            ControlFlow::Continue(())
        }
        None => ControlFlow::Continue(()),
    })
}

/// Why an upload ended without success.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum UploadFault {
    /// The aggregator will not have it.
    #[error("the aggregator refuses the model: {0}")]
    Refused(RefusalReason),
    /// The broker takes no messages of a size that makes sense.
    #[error("the broker takes too small messages; raise its largest packet size: {0}")]
    LinkTooNarrow(PublishError),
}
