//! The receiving half of the protocol. It collects models from headers and chunks, which may arrive in any
//! order, duplicated or damaged. It requests missing chunks, and its memory is bounded. It acknowledges a
//! model only after the caller has stored the body on disk.
//!
//! An upload takes little memory until its chunks arrive ([`room`]).

mod resume;
mod room;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use cosurf_wire::{
    BodyHash, Chunk, DeviceId, Done, Message, ModelHeader, ModelId, ModelKind, RefusalReason, Refused, Reply,
    Topic,
};

use crate::arrived::ArrivedStore;
use crate::identity::{Identity, Role};
use crate::key::ModelKey;
use crate::pacing::{ABANDONED, NUMBERS_IN_REACH};
use crate::transfer::{ChunkOutcome, Transfer, TransferPhase};
use crate::transport::Outgoing;
use crate::trust::Credentials;

/// Maximum number of queued replies. While the queue is full, messages get no reply, and their senders retry.
const REPLIES_MAX: usize = 256;

/// The limits of a receiver.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct InboxLimits {
    /// Maximum size in bytes of a body, and also of its unpacked model.
    pub body_bytes_max: u64,
    /// Maximum number of bytes that all bodies together take that are being received or stored. This bounds the memory of
    /// the inbox.
    pub total_bytes_max: u64,
    /// Maximum number of models that are being received or stored.
    pub models_max: usize,
    /// Maximum number of stored models that are remembered. A repeated offer of such a model is acknowledged
    /// without a new transfer.
    pub stored_max: usize,
}

impl InboxLimits {
    /// Limits of a participant that takes no models, and leaves offers unanswered.
    pub const CLOSED: Self = Self { body_bytes_max: 0, total_bytes_max: 0, models_max: 0, stored_max: 0 };
}

impl Default for InboxLimits {
    /// Limits for an aggregator: 2 million splats of degree 3 per model, and 1 GiB in total.
    fn default() -> Self {
        Self { body_bytes_max: 512 << 20, total_bytes_max: 1 << 30, models_max: 64, stored_max: 4096 }
    }
}

/// A task of the inbox for its caller.
#[derive(Clone, Debug)]
pub enum InboxAction {
    /// Publish this message.
    Publish(Outgoing),
    /// Store this model on disk, then call [`Inbox::stored`], [`Inbox::store_failed`] or [`Inbox::refuse`].
    Store {
        /// The model's header.
        header: ModelHeader,
        /// The body, checked by [`crate::check_body`].
        body: Arc<Vec<u8>>,
    },
}

/// The effect of a message on the inbox.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum InboxEvent {
    /// The inbox accepted an offer, and requests its chunks.
    Receiving(ModelHeader),
    /// The offered model is already stored. The inbox acknowledges the model again.
    Known(ModelHeader),
    /// The inbox refused an offer or a body.
    Refused(ModelKey, RefusalReason),
    /// The inbox dropped a header that does not match its topic.
    BadHeader,
    /// The inbox dropped a chunk that contradicts its header or its topic. Or the chunk completed a body with a
    /// wrong hash, and the inbox fetches the whole body again.
    BadChunk(ModelKey, u32),
}

/// Collects models from headers and chunks.
///
/// # Examples
///
/// ```
/// use std::time::Duration;
///
/// use cosurf_link::inbox::{InboxAction, InboxEvent};
/// use cosurf_link::{Identity, Inbox, InboxLimits, Offer, Role};
/// use cosurf_scene::Splats;
/// use cosurf_wire::{Chunk, DeviceId, ModelId, ModelKind, SiteId, Topic};
///
/// let (device, model) = (DeviceId::new("drone-1")?, ModelId(1));
/// let mut splats = Splats::with_capacity(1, 0);
/// splats.push([0.0; 3], [1.0, 0.0, 0.0, 0.0], [-2.0; 3], 1.0, &[0.5; 3]);
/// let Offer { header, body } = Offer::new(device, model, ModelKind::Local, 3, &splats, &[])?;
///
/// let (site, ground) = (SiteId::new("quarry")?, DeviceId::new("ground")?);
/// let identity = Identity { site, device: ground, session: 1, role: Role::Aggregator };
/// let mut inbox = Inbox::new(identity, InboxLimits::default(), &[]);
///
/// // The header announces the model, and the inbox replies with a Want.
/// let now = Duration::ZERO;
/// let event = inbox.on_header(now, &Topic::LocalHeader { device, model }, header, 1);
/// assert_eq!(event, Some(InboxEvent::Receiving(header)));
/// assert!(matches!(inbox.next(now), Some(InboxAction::Publish(_))));
///
/// // This body fits one chunk. The inbox hands it out for storing, and then acknowledges it.
/// let chunk = Chunk { device, model, index: 0, payload: &body };
/// inbox.on_chunk(now, &Topic::LocalChunk { device, model, index: 0 }, &chunk);
/// assert!(matches!(inbox.next(now), Some(InboxAction::Store { .. })));
/// inbox.stored((&header).into());
/// let Some(InboxAction::Publish(done)) = inbox.next(now) else { panic!("no acknowledgement") };
/// assert_eq!(done.topic.as_str(), "gs/v1/quarry/drone-1/dn/done");
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct Inbox {
    identity: Identity,
    credentials: Credentials,
    limits: InboxLimits,
    transfers: BTreeMap<ModelKey, Transfer>,
    stored: BTreeMap<ModelKey, BodyHash>,
    /// The tiles of the global model that are accepted, with the hashes of their bodies.
    expected: BTreeMap<ModelKey, BodyHash>,
    /// The keys in `stored`, oldest first.
    stored_order: VecDeque<ModelKey>,
    replies: VecDeque<Outgoing>,
    /// What has arrived of unfinished models, if it must outlast a restart.
    arrived: Option<ArrivedStore>,
}

impl Inbox {
    /// Makes an inbox. `stored` has the headers of the models that the caller already has on disk.
    pub fn new(identity: Identity, limits: InboxLimits, stored: &[ModelHeader]) -> Self {
        let mut inbox = Self {
            identity,
            credentials: Credentials::default(),
            limits,
            transfers: BTreeMap::new(),
            stored: BTreeMap::new(),
            expected: BTreeMap::new(),
            stored_order: VecDeque::new(),
            replies: VecDeque::new(),
            arrived: None,
        };
        stored.iter().for_each(|header| inbox.remember(header.into(), header.blake3));
        inbox
    }

    /// Sets the world frame and the trusted keys. The inbox then accepts only models in that frame, signed
    /// with a trusted key if there is a list of keys.
    pub fn set_credentials(&mut self, credentials: Credentials) {
        self.credentials = credentials;
    }

    /// Accepts these tiles of the global model from now on, and no others. What has arrived of others is dropped.
    pub fn expect_tiles(&mut self, tiles: BTreeMap<ModelKey, BodyHash>) {
        self.expected = tiles;
        let arrived = self.arrived.as_mut();
        let is_old = |key: &ModelKey| key.model.is_tile() && !self.expected.contains_key(key);
        arrived.into_iter().for_each(|arrived| arrived.remove_all(is_old));
        let expected = &self.expected;
        self.transfers.retain(|key, transfer| {
            !key.model.is_tile()
                || transfer.phase == TransferPhase::Storing
                || expected.get(key) == Some(&transfer.header.blake3)
        });
    }

    /// Drops what has arrived of unfinished uploads of these devices, except a model that the caller is storing.
    pub(crate) fn drop_uploads_of(&mut self, devices: &BTreeSet<DeviceId>) {
        self.transfers.retain(|key, transfer| {
            !devices.contains(&key.device) || transfer.phase == TransferPhase::Storing
        });
        self.drop_arrived(|key| devices.contains(&key.device));
    }

    pub(crate) fn credentials(&self) -> &Credentials {
        &self.credentials
    }

    /// Handles an offer that arrived under `topic`. `session` is that of the sender, which replies repeat; 0 if the sender
    /// did not tell it.
    pub fn on_header(
        &mut self,
        now: Duration,
        topic: &Topic,
        header: ModelHeader,
        session: u64,
    ) -> Option<InboxEvent> {
        if self.limits == InboxLimits::CLOSED {
            return None;
        }
        let key = ModelKey::from(&header);
        let want_topic = self.want_topic(topic)?;
        if !matches_topic(topic, &header) {
            return Some(InboxEvent::BadHeader);
        }
        // A tile that the newest manifest does not name is not wanted yet, or not any more.
        if key.model.is_tile() && self.expected.get(&key) != Some(&header.blake3) {
            return None;
        }
        let is_local = matches!(topic, Topic::LocalHeader { .. });
        if let Err(reason) = self.check(&header, is_local) {
            return self.refuse_offer(topic, key, session, reason);
        }
        if let Some(hash) = self.stored.get(&key) {
            return match *hash == header.blake3 {
                true => {
                    self.send_done(want_topic, key, session, header.blake3);
                    Some(InboxEvent::Known(header))
                }
                false => self.refuse_offer(topic, key, session, RefusalReason::NumberTaken),
            };
        }
        if let Some(transfer) = self.transfers.get_mut(&key) {
            let is_signed = self.credentials.trusted.is_some();
            match transfer.phase {
                TransferPhase::ToStore { is_retry: true, .. } if transfer.header == header => {
                    return self.refuse_offer(topic, key, session, RefusalReason::StoreFailed);
                }
                TransferPhase::Fetching { .. } if transfer.header != header => {
                    let is_kept = !transfer.may_be_replaced(now, &header, is_signed);
                    if is_kept || transfer.continue_with(now, header, session) {
                        return None;
                    }
                }
                _ => {
                    transfer.session = session;
                    transfer.on_offered_again(now);
                    return None;
                }
            }
            self.transfers.remove(&key);
        }
        self.accept(now, topic, header, session)
    }

    /// Handles a chunk that arrived under `topic`.
    pub fn on_chunk(&mut self, now: Duration, topic: &Topic, chunk: &Chunk<'_>) -> Option<InboxEvent> {
        let key = ModelKey { device: chunk.device, model: chunk.model };
        let agrees = match topic {
            Topic::LocalChunk { device, model, index } => {
                (*device, *model, *index) == (chunk.device, chunk.model, chunk.index)
            }
            Topic::GlobalChunk { model, index, .. } | Topic::TileChunk { model, index, .. } => {
                (*model, *index) == (chunk.model, chunk.index)
            }
            _ => false,
        };
        let bad = Some(InboxEvent::BadChunk(key, chunk.index));
        // Chunks that arrive after their model was stored or refused are ignored.
        let transfer = self.transfers.get_mut(&key)?;
        if !agrees {
            return bad;
        }
        let outcome = transfer.on_chunk(now, chunk);
        let begins_anew = transfer.received_bytes() == 0;
        match outcome {
            ChunkOutcome::Taken => {
                self.keep_chunk(key, chunk.index, chunk.payload);
                self.make_room_for_more(now, key);
                None
            }
            ChunkOutcome::Known => None,
            ChunkOutcome::Bad => {
                if begins_anew {
                    self.drop_arrived(|other| *other == key);
                }
                bad
            }
            ChunkOutcome::BadBody(reason) => self.refuse(key, reason),
        }
    }

    /// Notes a new connection.
    pub(crate) fn on_connected(&mut self, now: Duration) {
        self.transfers.values_mut().for_each(|transfer| transfer.on_connected(now));
    }

    /// Notes that a sender has connected again. It is told at once what has arrived of its models since it was last told.
    pub(crate) fn on_birth(&mut self, now: Duration, device: DeviceId) {
        let of_sender = self.transfers.iter_mut().filter(|(key, _)| key.device == device);
        of_sender.for_each(|(_, transfer)| transfer.tell_what_is_new(now));
    }

    /// Returns the next task that is due. Drops abandoned transfers.
    pub fn next(&mut self, now: Duration) -> Option<InboxAction> {
        if let Some(reply) = self.replies.pop_front() {
            return Some(InboxAction::Publish(reply));
        }
        self.transfers.retain(|_, transfer| {
            transfer.phase == TransferPhase::Storing || now.saturating_sub(transfer.last_news) < ABANDONED
        });
        while let Some(key) = self.due(now) {
            self.make_room_for_more(now, key);
            let transfer = self.transfers.get_mut(&key)?;
            if let TransferPhase::ToStore { .. } = transfer.phase {
                transfer.phase = TransferPhase::Storing;
                return Some(InboxAction::Store { header: transfer.header, body: transfer.body() });
            }
            if transfer.lacks_room() {
                transfer.wait_for_room(now);
                continue;
            }
            let (topic, want) = (transfer.want_topic, Message::Want(transfer.want(now)));
            return Some(InboxAction::Publish(Outgoing::new(&self.identity.site, topic, &want, false)));
        }
        None
    }

    /// Time at which [`Self::next`] next has a task, if no message arrives before. A time that has passed means
    /// that a task is due now; `None` means that none is scheduled.
    pub fn next_wakeup(&self) -> Option<Duration> {
        let replies = (!self.replies.is_empty()).then_some(Duration::ZERO);
        replies.or_else(|| self.transfers.values().filter_map(Transfer::due).min())
    }

    /// Call this when the body of [`InboxAction::Store`] is on disk, synced and renamed. The inbox then
    /// acknowledges the model.
    pub fn stored(&mut self, key: ModelKey) {
        let Some(transfer) = self.transfers.remove(&key) else { return };
        let hash = transfer.header.blake3;
        let is_outdated = |other: &ModelKey| {
            other.device == key.device && other.model <= key.model && !other.model.is_tile()
        };
        self.drop_arrived(|other| *other == key || is_outdated(other));
        self.remember(key, hash);
        self.send_done(transfer.want_topic, key, transfer.session, hash);
    }

    /// Forgets that a model was stored.
    pub fn forget(&mut self, key: ModelKey) {
        if self.stored.remove(&key).is_some() {
            self.stored_order.retain(|stored| *stored != key);
        }
    }

    /// Call this when storing failed and a retry may succeed, for example on a full disk. The inbox tells the
    /// sender, keeps the body, and hands it out again later.
    pub fn store_failed(&mut self, now: Duration, key: ModelKey) {
        let Some(transfer) = self.transfers.get_mut(&key) else { return };
        transfer.on_store_failed(now);
        let (topic, session) = (transfer.want_topic, transfer.session);
        self.send_refused(topic, key, session, RefusalReason::StoreFailed);
    }

    /// Drops an unfinished model, and sends `reason` to the model's sender.
    pub fn refuse(&mut self, key: ModelKey, reason: RefusalReason) -> Option<InboxEvent> {
        let transfer = self.transfers.remove(&key)?;
        self.drop_arrived(|other| *other == key);
        self.send_refused(transfer.want_topic, key, transfer.session, reason);
        Some(InboxEvent::Refused(key, reason))
    }

    /// Bytes that the bodies take which are being received or stored.
    pub fn unfinished_bytes(&self) -> u64 {
        self.transfers.values().map(Transfer::claim).sum()
    }

    /// Checks the frame and the number of an offer.
    fn check(&self, header: &ModelHeader, is_local: bool) -> Result<(), RefusalReason> {
        if header.frame != self.credentials.frame {
            return Err(RefusalReason::WrongFrame);
        }
        let is_signed = self.credentials.trusted.is_some();
        let counts = |newest: &ModelId| is_signed || (is_local && newest.0 < NUMBERS_IN_REACH);
        let newest = self.newest_stored(header.into()).filter(counts);
        if newest.is_some_and(|newest| header.model < newest) {
            return Err(RefusalReason::Replayed);
        }
        Ok(())
    }

    fn accept(
        &mut self,
        now: Duration,
        topic: &Topic,
        header: ModelHeader,
        session: u64,
    ) -> Option<InboxEvent> {
        let key = ModelKey::from(&header);
        let bytes = header.body_bytes.max(header.unpacked_bytes());
        if bytes > self.limits.body_bytes_max.min(self.limits.total_bytes_max) {
            return self.refuse_offer(topic, key, session, RefusalReason::TooLarge);
        }
        if !matches!(topic, Topic::LocalHeader { .. }) && !key.model.is_tile() {
            self.drop_older_revisions(key);
        }
        let Some(claim) = self.make_room_for(now, &header) else {
            return self.refuse_offer(topic, key, session, RefusalReason::Busy);
        };
        let transfer = Transfer::new(now, header, session, claim, self.want_topic(topic)?);
        self.transfers.insert(key, transfer);
        self.resume(now, key).or(Some(InboxEvent::Receiving(header)))
    }

    /// A model for which there is something to do now.
    fn due(&self, now: Duration) -> Option<ModelKey> {
        let is_due = |transfer: &Transfer| transfer.due().is_some_and(|due| due <= now);
        self.transfers.iter().find(|(_, transfer)| is_due(transfer)).map(|(key, _)| *key)
    }

    /// The highest number that is stored from the device of `key`; `None` if there is none or if `key` itself
    /// is stored. Tiles do not count, and `None` for a tile: the manifest tells which are up to date.
    fn newest_stored(&self, key: ModelKey) -> Option<ModelId> {
        if key.model.is_tile() {
            return None;
        }
        let (first, last) =
            (ModelKey { model: ModelId(0), ..key }, ModelKey { model: ModelId(u64::MAX), ..key });
        let mut whole = self.stored.range(first..=last).rev().filter(|(key, _)| !key.model.is_tile());
        let newest = whole.next()?.0.model;
        // A stored model is offered again if the acknowledgement was lost. Such an offer is not a replay.
        (!self.stored.contains_key(&key)).then_some(newest)
    }

    /// Topic of the `Want`s that answer an offer under `topic`; `None` if this participant does not receive
    /// such offers.
    fn want_topic(&self, topic: &Topic) -> Option<Topic> {
        match (self.identity.role, topic) {
            (Role::Aggregator, Topic::LocalHeader { device, .. }) => {
                Some(Topic::LocalReply { device: *device, reply: Reply::Want })
            }
            (Role::Device, Topic::GlobalHeader { .. }) => {
                Some(Topic::GlobalReply { device: self.identity.device, reply: Reply::Want })
            }
            (Role::Device, Topic::TileHeader { device, .. }) if *device == self.identity.device => {
                Some(Topic::GlobalReply { device: *device, reply: Reply::Want })
            }
            _ => None,
        }
    }

    /// Drops global models of the same sender with lower numbers, because `newest` replaces them. Keeps a model
    /// that the caller is storing.
    fn drop_older_revisions(&mut self, newest: ModelKey) {
        self.transfers.retain(|key, transfer| {
            key.device != newest.device
                || key.model > newest.model
                || transfer.phase == TransferPhase::Storing
        });
        self.drop_arrived(|key| {
            key.device == newest.device && key.model < newest.model && !key.model.is_tile()
        });
    }

    fn remember(&mut self, key: ModelKey, hash: BodyHash) {
        if self.stored.insert(key, hash).is_none() {
            self.stored_order.push_back(key);
        }
        if self.stored_order.len() > self.limits.stored_max {
            let oldest = self.stored_order.pop_front();
            oldest.map(|key| self.stored.remove(&key));
        }
    }

    fn refuse_offer(
        &mut self,
        topic: &Topic,
        key: ModelKey,
        session: u64,
        reason: RefusalReason,
    ) -> Option<InboxEvent> {
        let topic = self.want_topic(topic)?;
        self.send_refused(topic, key, session, reason);
        Some(InboxEvent::Refused(key, reason))
    }

    fn send_done(&mut self, topic: Topic, key: ModelKey, session: u64, blake3: BodyHash) {
        let done = Done { device: key.device, model: key.model, session, blake3 };
        self.queue_reply(topic, Reply::Done, &Message::Done(done));
    }

    fn send_refused(&mut self, topic: Topic, key: ModelKey, session: u64, reason: RefusalReason) {
        let refused = Refused { device: key.device, model: key.model, session, reason };
        self.queue_reply(topic, Reply::Refused, &Message::Refused(refused));
    }

    /// Queues a reply of kind `reply` under the topic that corresponds to `want_topic`. Drops the reply if the
    /// queue is full.
    fn queue_reply(&mut self, want_topic: Topic, reply: Reply, message: &Message<'_>) {
        let topic = match want_topic {
            Topic::LocalReply { device, .. } => Topic::LocalReply { device, reply },
            Topic::GlobalReply { device, .. } => Topic::GlobalReply { device, reply },
            other => other,
        };
        if self.replies.len() < REPLIES_MAX {
            self.replies.push_back(Outgoing::new(&self.identity.site, topic, message, false));
        }
    }
}

/// Whether a header fits its topic. The kind of model must be the topic's kind. For a local model, the device and
/// the model's number must also be those of the topic. The result is false if the topic is not one for headers.
fn matches_topic(topic: &Topic, header: &ModelHeader) -> bool {
    match topic {
        Topic::LocalHeader { device, model } => {
            let is_local = matches!(header.kind, ModelKind::Local | ModelKind::Compressed);
            is_local && (*device, *model) == (header.device, header.model)
        }
        Topic::GlobalHeader { .. } => {
            matches!(header.kind, ModelKind::Global | ModelKind::Manifest) && !header.model.is_tile()
        }
        Topic::TileHeader { model, .. } => {
            header.kind == ModelKind::Global && header.model.is_tile() && *model == header.model
        }
        _ => false,
    }
}
