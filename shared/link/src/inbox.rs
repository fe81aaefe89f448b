//! The receiving half of the conversation: collects models from headers and chunks in any order, doubled
//! or damaged, within limits; asks for what is missing; says that it is done only after its owner has
//! the body on a disk.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use cosurf_wire::{
    BodyHash, Chunk, Done, Message, ModelHeader, ModelId, ModelKind, RefusalReason, Refused, Reply, Topic,
};

use crate::body::Model;
use crate::identity::{Identity, Role};
use crate::key::ModelKey;
use crate::pacing::{ABANDONED, STALLED};
use crate::transfer::{ChunkOutcome, Phase, Transfer};
use crate::transport::Outgoing;
use crate::trust::Credentials;

/// Answers waiting to be sent; what does not fit is not answered, and asked again.
const REPLIES_MAX: usize = 256;

/// What a receiver takes at most.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct InboxLimits {
    /// Bytes of one body, and of its model once it is unpacked.
    pub body_bytes_max: u64,
    /// Bytes of all unfinished bodies together; the memory the inbox may take.
    pub total_bytes_max: u64,
    /// Unfinished models at once.
    pub models_max: usize,
    /// Finished models remembered, so that a repeated offer is answered without the body.
    pub stored_max: usize,
}

impl Default for InboxLimits {
    /// For an aggregator: 2 million splats of degree 3 in a model, 1 GiB in all.
    fn default() -> Self {
        Self { body_bytes_max: 512 << 20, total_bytes_max: 1 << 30, models_max: 64, stored_max: 4096 }
    }
}

/// What an inbox asks of its owner.
#[derive(Clone, Debug)]
pub enum InboxAction {
    /// Send this.
    Publish(Outgoing),
    /// Write this to a disk, then call [`Inbox::stored`], [`Inbox::store_failed`] or [`Inbox::refuse`].
    Store {
        /// What was announced, and holds.
        header: ModelHeader,
        /// The body, checked by [`crate::check_body`].
        body: Arc<Vec<u8>>,
    },
}

/// What an inbox learns from a message.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum InboxEvent {
    /// An offer was accepted; its chunks are asked for.
    Receiving(ModelHeader),
    /// An offer of what is stored already; its sender is told so again.
    Known(ModelHeader),
    /// An offer or a body was refused.
    Refused(ModelKey, RefusalReason),
    /// A chunk of the wrong size or under the wrong topic was thrown away.
    BadChunk(ModelKey, u32),
}

/// Collects models.
#[derive(Debug)]
pub struct Inbox {
    identity: Identity,
    credentials: Credentials,
    limits: InboxLimits,
    transfers: BTreeMap<ModelKey, Transfer>,
    stored: BTreeMap<ModelKey, BodyHash>,
    /// Keys of `stored`, oldest first.
    stored_order: VecDeque<ModelKey>,
    replies: VecDeque<Outgoing>,
}

impl Inbox {
    /// An inbox that holds the models of `stored` already.
    pub fn new(identity: Identity, limits: InboxLimits, stored: &[ModelHeader]) -> Self {
        let mut inbox = Self {
            identity,
            credentials: Credentials::default(),
            limits,
            transfers: BTreeMap::new(),
            stored: BTreeMap::new(),
            stored_order: VecDeque::new(),
            replies: VecDeque::new(),
        };
        stored.iter().for_each(|header| inbox.remember(header.into(), header.blake3));
        inbox
    }

    /// From now on takes only what these believe.
    pub fn believe(&mut self, credentials: Credentials) {
        self.credentials = credentials;
    }

    pub(crate) fn credentials(&self) -> &Credentials {
        &self.credentials
    }

    /// Takes an offer that came under `topic`.
    pub fn on_header(&mut self, now: Duration, topic: &Topic, header: ModelHeader) -> Option<InboxEvent> {
        let key = ModelKey::from(&header);
        let replies = self.replies_for(topic)?;
        if !is_honest(topic, &header) {
            return self.on_bad_header(topic);
        }
        if let Err(reason) = self.credentials.check(&self.identity.site, &header, self.newest_stored(key)) {
            return self.turn_away(topic, key, reason);
        }
        if let Some(hash) = self.stored.get(&key) {
            return match *hash == header.blake3 {
                true => {
                    self.say_done(replies, key, header.blake3);
                    Some(InboxEvent::Known(header))
                }
                false => self.turn_away(topic, key, RefusalReason::NumberTaken),
            };
        }
        if let Some(transfer) = self.transfers.get_mut(&key) {
            match transfer.phase {
                Phase::ToStore { is_retry: true, .. } if transfer.header == header => {
                    return self.turn_away(topic, key, RefusalReason::StoreFailed);
                }
                Phase::Fetching { .. } if transfer.header != header => {}
                _ => {
                    transfer.on_offered_again(now);
                    return None;
                }
            }
            self.transfers.remove(&key);
        }
        self.accept(now, topic, header)
    }

    /// A message under a header's topic that cannot be read, or is not what the topic says.
    pub fn on_bad_header(&mut self, topic: &Topic) -> Option<InboxEvent> {
        match topic {
            Topic::LocalHeader { device, model } => {
                let key = ModelKey { device: *device, model: *model };
                self.turn_away(topic, key, RefusalReason::BadHeader)
            }
            _ => None,
        }
    }

    /// Takes a chunk that came under `topic`.
    pub fn on_chunk(&mut self, now: Duration, topic: &Topic, chunk: &Chunk<'_>) -> Option<InboxEvent> {
        let key = ModelKey { device: chunk.device, model: chunk.model };
        let agrees = match topic {
            Topic::LocalChunk { device, model, index } => {
                (*device, *model, *index) == (chunk.device, chunk.model, chunk.index)
            }
            Topic::GlobalChunk { model, index, .. } => (*model, *index) == (chunk.model, chunk.index),
            _ => false,
        };
        let bad = Some(InboxEvent::BadChunk(key, chunk.index));
        // Late chunks of a model that is stored or refused are no news.
        let transfer = self.transfers.get_mut(&key)?;
        if !agrees {
            return bad;
        }
        match transfer.on_chunk(now, chunk) {
            ChunkOutcome::Taken | ChunkOutcome::Known => None,
            ChunkOutcome::Bad => bad,
            ChunkOutcome::Spoilt(reason) => self.refuse(key, reason),
        }
    }

    /// What is to be done now.
    pub fn next(&mut self, now: Duration) -> Option<InboxAction> {
        if let Some(reply) = self.replies.pop_front() {
            return Some(InboxAction::Publish(reply));
        }
        self.transfers.retain(|_, transfer| {
            transfer.phase == Phase::Storing || now.saturating_sub(transfer.last_news) < ABANDONED
        });
        let (_, transfer) =
            self.transfers.iter_mut().find(|(_, transfer)| transfer.due().is_some_and(|due| due <= now))?;
        if let Phase::ToStore { .. } = transfer.phase {
            transfer.phase = Phase::Storing;
            return Some(InboxAction::Store { header: transfer.header, body: transfer.body() });
        }
        let want = transfer.want(now);
        let message = Message::Want(want);
        Some(InboxAction::Publish(Outgoing::new(&self.identity.site, transfer.want_topic, &message, false)))
    }

    /// When [`Self::next`] will have something although nothing is heard; `Duration::ZERO` for at once.
    pub fn next_wakeup(&self) -> Option<Duration> {
        let replies = (!self.replies.is_empty()).then_some(Duration::ZERO);
        replies.or_else(|| self.transfers.values().filter_map(Transfer::due).min())
    }

    /// The body that [`InboxAction::Store`] handed out is on the disk, synced and renamed: its sender is told.
    pub fn stored(&mut self, key: ModelKey) {
        let Some(transfer) = self.transfers.remove(&key) else { return };
        let hash = transfer.header.blake3;
        self.remember(key, hash);
        self.say_done(transfer.want_topic, key, hash);
    }

    /// It is not, and may be tried again (disk full): the body is kept and handed out again after a while.
    pub fn store_failed(&mut self, now: Duration, key: ModelKey) {
        let Some(transfer) = self.transfers.get_mut(&key) else { return };
        transfer.on_store_failed(now);
        let topic = transfer.want_topic;
        self.say_refused(topic, key, RefusalReason::StoreFailed);
    }

    /// An unfinished model is not wanted any more; its sender is told.
    pub fn refuse(&mut self, key: ModelKey, reason: RefusalReason) -> Option<InboxEvent> {
        let transfer = self.transfers.remove(&key)?;
        self.say_refused(transfer.want_topic, key, reason);
        Some(InboxEvent::Refused(key, reason))
    }

    /// Bytes of all unfinished bodies.
    pub fn unfinished_bytes(&self) -> u64 {
        self.transfers.values().map(|transfer| transfer.header.body_bytes).sum()
    }

    /// Models whose chunks have not all come.
    pub fn unfinished(&self) -> impl Iterator<Item = &ModelHeader> {
        let fetching = |transfer: &&Transfer| matches!(transfer.phase, Phase::Fetching { .. });
        self.transfers.values().filter(fetching).map(|transfer| &transfer.header)
    }

    /// What has come of an unfinished model, as far as that is a model already. Nothing where only signed models are
    /// believed: the signature holds the hash of the whole.
    pub fn part(&self, key: ModelKey) -> Option<Model> {
        self.transfers.get(&key).filter(|_| self.credentials.trusted.is_none())?.part()
    }

    fn accept(&mut self, now: Duration, topic: &Topic, header: ModelHeader) -> Option<InboxEvent> {
        let key = ModelKey::from(&header);
        let bytes = header.body_bytes.max(header.unpacked_bytes());
        if bytes > self.limits.body_bytes_max.min(self.limits.total_bytes_max) {
            return self.turn_away(topic, key, RefusalReason::TooLarge);
        }
        if header.kind == ModelKind::Global {
            self.forget_older_revisions(key);
        }
        if !self.make_room(now, header.body_bytes) {
            return self.turn_away(topic, key, RefusalReason::Busy);
        }
        self.transfers.insert(key, Transfer::new(now, header, self.replies_for(topic)?));
        Some(InboxEvent::Receiving(header))
    }

    /// The greatest number stored of a model's device, but for its own.
    fn newest_stored(&self, key: ModelKey) -> Option<ModelId> {
        let (first, last) =
            (ModelKey { model: ModelId(0), ..key }, ModelKey { model: ModelId(u64::MAX), ..key });
        let newest = self.stored.range(first..=last).next_back()?.0.model;
        // What is stored under a number is asked about again where an answer was lost: that is no replay.
        (!self.stored.contains_key(&key)).then_some(newest)
    }

    /// Where wants about what came under `topic` go; `None` where this side receives no such thing.
    fn replies_for(&self, topic: &Topic) -> Option<Topic> {
        match (self.identity.role, topic) {
            (Role::Aggregator, Topic::LocalHeader { device, .. }) => {
                Some(Topic::LocalReply { device: *device, reply: Reply::Want })
            }
            (Role::Device, Topic::GlobalHeader { .. }) => {
                Some(Topic::GlobalReply { device: self.identity.device, reply: Reply::Want })
            }
            _ => None,
        }
    }

    /// A newer global model makes unfinished older ones of the same maker useless.
    fn forget_older_revisions(&mut self, newest: ModelKey) {
        self.transfers.retain(|key, transfer| {
            key.device != newest.device || key.model > newest.model || transfer.phase == Phase::Storing
        });
    }

    /// Whether there is room for one more body, after stalled ones have given way.
    fn make_room(&mut self, now: Duration, body_bytes: u64) -> bool {
        let has_room = |inbox: &Self| {
            inbox.transfers.len() < inbox.limits.models_max
                && inbox.unfinished_bytes() + body_bytes <= inbox.limits.total_bytes_max
        };
        while !has_room(self) {
            let is_stalled = |transfer: &Transfer| {
                matches!(transfer.phase, Phase::Fetching { .. })
                    && now.saturating_sub(transfer.last_news) >= STALLED
            };
            let stalled = self.transfers.iter().filter(|(_, transfer)| is_stalled(transfer));
            let Some(oldest) = stalled.min_by_key(|(_, transfer)| transfer.last_news).map(|(key, _)| *key)
            else {
                return false;
            };
            self.transfers.remove(&oldest);
        }
        true
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

    fn turn_away(&mut self, topic: &Topic, key: ModelKey, reason: RefusalReason) -> Option<InboxEvent> {
        let topic = self.replies_for(topic)?;
        self.say_refused(topic, key, reason);
        Some(InboxEvent::Refused(key, reason))
    }

    fn say_done(&mut self, topic: Topic, key: ModelKey, blake3: BodyHash) -> Option<InboxEvent> {
        let done = Done { device: key.device, model: key.model, blake3 };
        self.reply(topic, Reply::Done, &Message::Done(done));
        None
    }

    fn say_refused(&mut self, topic: Topic, key: ModelKey, reason: RefusalReason) {
        let refused = Refused { device: key.device, model: key.model, reason };
        self.reply(topic, Reply::Refused, &Message::Refused(refused));
    }

    /// Queues an answer beside where wants go.
    fn reply(&mut self, want_topic: Topic, reply: Reply, message: &Message<'_>) {
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

/// Whether a header is of the kind that belongs under its topic, from the device that the topic names.
fn is_honest(topic: &Topic, header: &ModelHeader) -> bool {
    match topic {
        Topic::LocalHeader { device, model } => {
            header.kind != ModelKind::Global && (*device, *model) == (header.device, header.model)
        }
        Topic::GlobalHeader { .. } => header.kind == ModelKind::Global,
        _ => false,
    }
}
