//! The sending half of the conversation: offers a model, sends each receiver the chunks it wants, is
//! done with a receiver when that has the right bytes on its disk.
//!
//! Nothing is sent on suspicion: chunks leave only after a [`Want`], so a sender that starts again sends
//! only what is still missing. Chunks of a global model are heard by all devices, so one sending serves
//! all that want it.

use std::time::Duration;

use cosurf_wire::{
    Chunk, DeviceId, Done, MAX_MESSAGE_BYTES, Message, RefusalReason, Refused, Reply, SiteId, TileId, Topic,
    Want,
};

use crate::key::ModelKey;
use crate::offer::Offer;
use crate::pacing::{ANNOUNCE, Backoff};
use crate::peer::{Peer, Phase};
use crate::transport::Outgoing;

/// Receivers of a global model served at once; more are ignored.
const PEERS_MAX: usize = 1024;
/// Smallest chunk that a sender falls back to when the link takes no larger message. Ours: below it the
/// messages' own overhead tells.
const CHUNK_BYTES_MIN: u32 = 1024;

/// How far an offer has come.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct UploadProgress {
    /// Chunks of the body.
    pub chunks: u32,
    /// Chunks that the slowest required receiver is known to have.
    pub chunks_there: u32,
    /// Bytes of topics and payloads of all messages published, repetitions included.
    pub bytes_sent: u64,
}

/// What an uploader learns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum UploadEvent {
    /// A receiver has more than before.
    Progress,
    /// Every required receiver has it on its disk.
    Finished,
    /// A receiver refuses, for good unless the reason is passing.
    Refused(DeviceId, RefusalReason),
}

/// To whom a model goes.
#[derive(Clone, Copy, Debug)]
enum Lane {
    /// From a device to the aggregator.
    Local,
    /// From the aggregator to all devices.
    Global(TileId),
}

/// Offers one model until every receiver has it on its disk or refuses it.
#[derive(Debug)]
pub struct Uploader {
    site: SiteId,
    lane: Lane,
    offer: Offer,
    peers: Vec<Peer>,
    announce_at: Option<Duration>,
    backoff: Backoff,
    sent_chunks: u64,
    bytes_sent: u64,
    is_cleared: bool,
}

impl Uploader {
    /// Offers a device's model to the aggregator.
    pub fn local(site: SiteId, offer: Offer) -> Self {
        let device = offer.header.device;
        Self::new(site, Lane::Local, offer, &[device])
    }

    /// Offers a global model to all devices, and waits for `receivers`.
    pub fn global(site: SiteId, tile: TileId, offer: Offer, receivers: &[DeviceId]) -> Self {
        Self::new(site, Lane::Global(tile), offer, receivers)
    }

    fn new(site: SiteId, lane: Lane, offer: Offer, receivers: &[DeviceId]) -> Self {
        let chunks = offer.header.chunks();
        Self {
            site,
            lane,
            offer,
            peers: receivers.iter().map(|device| Peer::new(*device, chunks, true)).collect(),
            announce_at: Some(Duration::ZERO),
            backoff: ANNOUNCE,
            sent_chunks: 0,
            bytes_sent: 0,
            is_cleared: false,
        }
    }

    /// Which model.
    pub fn key(&self) -> ModelKey {
        self.offer.header.into()
    }

    /// The tile of a global model.
    pub fn tile(&self) -> Option<TileId> {
        match self.lane {
            Lane::Local => None,
            Lane::Global(tile) => Some(tile),
        }
    }

    /// How far it has come.
    pub fn progress(&self) -> UploadProgress {
        let chunks = self.offer.header.chunks();
        let there = self.peers.iter().filter(|peer| peer.is_required).map(|peer| peer.chunks_there(chunks));
        UploadProgress { chunks, chunks_there: there.min().unwrap_or(chunks), bytes_sent: self.bytes_sent }
    }

    /// Whether every required receiver has it or has refused it for good.
    pub fn is_settled(&self) -> bool {
        self.peers.iter().all(|peer| !peer.is_required || peer.is_settled())
    }

    /// Whether nothing is left to do. A global model is served until another takes its place.
    pub fn is_over(&self) -> bool {
        self.is_cleared
    }

    /// The transport stands (again): the offer is repeated, in case the broker has lost it.
    pub fn on_connected(&mut self, now: Duration) {
        self.backoff.reset();
        self.announce_at = Some(now);
    }

    /// The link takes no larger message than `max_bytes`: the offer is repeated with smaller chunks.
    /// `false` where that would be too small to make sense.
    pub fn shrink_chunks(&mut self, now: Duration, max_bytes: usize) -> bool {
        let overhead = MAX_MESSAGE_BYTES - cosurf_wire::MAX_CHUNK_BYTES + 2 * cosurf_wire::MAX_TOPIC_BYTES;
        let fitting = u32::try_from(max_bytes.saturating_sub(overhead)).unwrap_or(u32::MAX);
        let chunk_bytes = fitting.min(self.offer.header.chunk_bytes / 2);
        if chunk_bytes < CHUNK_BYTES_MIN {
            return false;
        }
        self.offer.header.chunk_bytes = chunk_bytes;
        let chunks = self.offer.header.chunks();
        for peer in self.peers.iter_mut().filter(|peer| !peer.is_settled()) {
            *peer = Peer::new(peer.device, chunks, peer.is_required);
        }
        self.on_connected(now);
        true
    }

    /// Takes an answer of a receiver; `None` where it changes nothing or is not for this model.
    pub fn hear(&mut self, now: Duration, topic: &Topic, message: &Message<'_>) -> Option<UploadEvent> {
        let (by, reply) = self.answer_on(topic)?;
        if subject(message) != Some(self.key()) || self.is_cleared {
            return None;
        }
        let chunks = self.offer.header.chunks();
        let index = self.peer_index(by, chunks)?;
        if self.peers[index].is_settled() {
            return None;
        }
        let before = self.peers[index].chunks_there(chunks);
        match (reply, message) {
            (Reply::Want, Message::Want(want)) => self.peers[index].on_want(chunks, want),
            (Reply::Done, Message::Done(done)) if done.blake3 == self.offer.header.blake3 => {
                self.peers[index].phase = Phase::Done;
            }
            (Reply::Refused, Message::Refused(refused)) => {
                self.peers[index].on_refused(refused.reason);
                self.pause_announcing(now);
                return Some(UploadEvent::Refused(by, refused.reason));
            }
            _ => return None,
        }
        self.backoff.reset();
        self.pause_announcing(now);
        if self.peers[index].is_required && self.is_finished() {
            return Some(UploadEvent::Finished);
        }
        (self.peers[index].chunks_there(chunks) != before).then_some(UploadEvent::Progress)
    }

    /// The next message to publish, if it is time for one. What is handed out here must be published.
    pub fn next(&mut self, now: Duration) -> Option<Outgoing> {
        let message = match self.lane {
            Lane::Local if self.is_settled() => self.take_back_offer(),
            _ if self.announce_at.is_some_and(|at| now >= at) => Some(self.announce(now)),
            _ => self.next_chunk(),
        }?;
        self.bytes_sent += (message.topic.len() + message.payload.len()) as u64;
        Some(message)
    }

    /// When [`Self::next`] will have something although nothing is heard; it may have it before.
    pub fn next_wakeup(&self) -> Option<Duration> {
        if self.is_cleared { None } else { self.announce_at }
    }

    fn is_finished(&self) -> bool {
        self.peers.iter().all(|peer| !peer.is_required || peer.phase == Phase::Done)
    }

    /// Whether `topic` carries answers to this uploader, whose and which.
    fn answer_on(&self, topic: &Topic) -> Option<(DeviceId, Reply)> {
        match (self.lane, topic) {
            (Lane::Local, Topic::LocalReply { device, reply }) => Some((*device, *reply)),
            (Lane::Global(_), Topic::GlobalReply { device, reply }) => Some((*device, *reply)),
            _ => None,
        }
    }

    /// The peer that answers. Devices that come late to a global model are taken in.
    fn peer_index(&mut self, device: DeviceId, chunks: u32) -> Option<usize> {
        let known = self.peers.iter().position(|peer| peer.device == device);
        let may_join = matches!(self.lane, Lane::Global(_)) && self.peers.len() < PEERS_MAX;
        if known.is_none() && may_join {
            self.peers.push(Peer::new(device, chunks, false));
            return Some(self.peers.len() - 1);
        }
        known
    }

    /// Offers again only after a silence; not at all when all that were waited for are settled.
    fn pause_announcing(&mut self, now: Duration) {
        self.announce_at = if self.is_settled() { None } else { Some(now + self.backoff.delay()) };
    }

    fn announce(&mut self, now: Duration) -> Outgoing {
        let header = self.offer.header;
        let topic = match self.lane {
            Lane::Local => Topic::LocalHeader { device: header.device, model: header.model },
            Lane::Global(tile) => Topic::GlobalHeader { tile },
        };
        self.pause_announcing(now);
        Outgoing::new(&self.site, topic, &Message::Header(header), true)
    }

    fn next_chunk(&mut self) -> Option<Outgoing> {
        let index = self.peers.iter().filter_map(Peer::next_chunk).min()?;
        self.sent_chunks += 1;
        self.peers.iter_mut().for_each(|peer| peer.on_sent(index, self.sent_chunks));
        let header = &self.offer.header;
        let range = header.chunk_range(index)?;
        let payload = &self.offer.body[range.start as usize..range.end as usize];
        let (device, model) = (header.device, header.model);
        let chunk = Chunk { device, model, index, payload };
        let topic = match self.lane {
            Lane::Local => Topic::LocalChunk { device, model, index },
            Lane::Global(tile) => Topic::GlobalChunk { tile, model, index },
        };
        Some(Outgoing::new(&self.site, topic, &Message::Chunk(chunk), false))
    }

    /// The retained header of a local model goes once it is of no more use.
    fn take_back_offer(&mut self) -> Option<Outgoing> {
        let topic = Topic::LocalHeader { device: self.key().device, model: self.key().model };
        let clear = (!self.is_cleared).then(|| Outgoing::clear(&self.site, topic));
        self.is_cleared = true;
        clear
    }
}

/// The model that a receiver's answer is about.
fn subject(message: &Message<'_>) -> Option<ModelKey> {
    let (device, model) = match message {
        Message::Want(Want { device, model, .. })
        | Message::Refused(Refused { device, model, .. })
        | Message::Done(Done { device, model, .. }) => (*device, *model),
        Message::Header(_) | Message::Chunk(_) | Message::State(_) | Message::Flight(_) => return None,
    };
    Some(ModelKey { device, model })
}
