//! The sending half of the protocol: offers a model, and sends each receiver the chunks that it lacks, until
//! the receiver has stored the model.
//!
//! Chunks are sent only after a [`Want`], so a restarted sender sends only the missing chunks. A chunk of a
//! global model reaches all devices at once, so it is not sent to each of them separately. A chunk that only one device
//! lacks later is sent to that device only. How often chunks are sent again is limited for each receiver.

use std::time::Duration;

use cosurf_wire::{
    Chunk, DeviceId, Done, MAX_MESSAGE_BYTES, Message, Missing, ModelId, RefusalReason, Refused, Reply,
    SiteId, TileId, Topic, Want,
};

use crate::bits::BitSet;
use crate::key::ModelKey;
use crate::offer::Offer;
use crate::pacing::{
    ANNOUNCE, ANNOUNCE_AGAIN, ANNOUNCE_ANSWERED, ASKED_AGAIN, Backoff, RENUMBERED_MAX, SHRINK, STORED_AGAIN,
    STORED_OFFER, UNANSWERED_OFFERS,
};
use crate::peer::{Peer, PeerPhase};
use crate::transport::Outgoing;

/// Limit on the receivers of a global model, and on the devices whose sessions a node remembers, unless another is set.
pub const DEVICES_MAX: usize = 1024;

/// Smallest chunk, in bytes, that a sender uses when the link limits the size of messages, or breaks often. With smaller
/// chunks, the overhead of the messages would be too large: here it is a tenth.
const CHUNK_BYTES_MIN: u32 = 512;

/// The progress of an upload.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct UploadProgress {
    /// Number of chunks of the body.
    pub chunks: u32,
    /// Number of chunks that the slowest required receiver is known to have; all if no receiver is required.
    pub chunks_received: u32,
    /// Bytes of the body in those chunks.
    pub bytes_arrived: u64,
    /// Bytes of the topics and payloads of all messages published, including retries, but without the chunks of which the
    /// transport has told that they are lost.
    pub bytes_sent: u64,
}

/// The effect of a reply on an upload.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum UploadEvent {
    /// The number of chunks that a receiver is known to have has changed. It falls if the receiver was
    /// restarted.
    Progress,
    /// Every required receiver has stored the model.
    Finished,
    /// A receiver refuses the model. The refusal is final unless [`RefusalReason::is_temporary`]. The device
    /// is the receiver of a global model, but the sender of a local one.
    Refused(DeviceId, RefusalReason),
    /// A receiver has lost the model that it had stored, and gets it again: the aggregator a device's model, or this device
    /// the global one. Of a device's model, it is the device that sends it.
    AskedAgain(DeviceId),
    /// A device wants the global model, and is one receiver too many. Its replies are ignored. Reported for the first
    /// such device only.
    TooManyPeers(DeviceId),
}

/// Who receives a model.
#[derive(Clone, Copy, Debug)]
enum Destination {
    /// The aggregator, for a device's model.
    Aggregator,
    /// All devices, for the global model of a tile.
    Devices(TileId),
    /// One device, for a tile of the global model.
    Device(DeviceId),
}

/// Offers one model and sends its chunks. A local model is offered until the aggregator has stored it or
/// refused it for good, a global model until another model replaces it.
///
/// # Examples
///
/// ```
/// use std::time::Duration;
///
/// use cosurf_link::uploader::UploadEvent;
/// use cosurf_link::{Offer, Uploader};
/// use cosurf_scene::Splats;
/// use cosurf_wire::{DeviceId, Done, Message, ModelId, ModelKind, Reply, SiteId, Topic};
///
/// let (site, device, model) = (SiteId::new("quarry")?, DeviceId::new("drone-1")?, ModelId(1));
/// let mut splats = Splats::with_capacity(1, 0);
/// splats.push([0.0; 3], [1.0, 0.0, 0.0, 0.0], [-2.0; 3], 1.0, &[0.5; 3]);
/// let offer = Offer::new(device, model, ModelKind::Local, 3, &splats, &[])?;
/// let blake3 = offer.header.blake3;
/// let mut uploader = Uploader::local(site, offer);
///
/// // First it announces the model by its header.
/// let now = Duration::ZERO;
/// let announcement = uploader.next(now).expect("the header is due at once");
/// assert_eq!(announcement.topic.as_str(), "gs/v1/quarry/drone-1/up/1/m");
/// assert_eq!(uploader.next(now), None, "chunks are sent only after a Want");
///
/// // This aggregator has stored the body in an earlier session.
/// let topic = Topic::LocalReply { device, reply: Reply::Done };
/// let reply = Message::Done(Done { device, model, session: 0, blake3 });
/// assert_eq!(uploader.on_reply(now, &topic, &reply), Some(UploadEvent::Finished));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct Uploader {
    site: SiteId,
    destination: Destination,
    offer: Offer,
    peers: Vec<Peer>,
    peers_max: usize,
    signs: bool,
    is_full_told: bool,
    announce_at: Option<Duration>,
    announced_at: Option<Duration>,
    backoff: Backoff,
    /// Chunks of a global model that were sent to all devices.
    broadcast: BitSet,
    sent_chunks: u64,
    bytes_sent: u64,
    is_cleared: bool,
    /// When the aggregator may ask again for a model that it has stored.
    ask_again_at: Duration,
    /// Number of offers since the last reply, and that number when it was last reported.
    unanswered: u32,
    told_unanswered: u32,
    /// How often the model was given another number.
    renumbered: u32,
    /// When a stored model of a device is offered again.
    offer_stored_at: Option<Duration>,
    /// Whether that has happened. Then the aggregator may ask for the model as for any other.
    is_stored_offered: bool,
    /// When that last happened.
    stored_offered_at: Option<Duration>,
}

impl Uploader {
    /// Offers a device's model to the aggregator.
    pub fn local(site: SiteId, offer: Offer) -> Self {
        let device = offer.header.device;
        Self::new(site, Destination::Aggregator, offer, &[device])
    }

    /// Offers a global model to all devices. [`UploadEvent::Finished`] follows when all `receivers` have
    /// stored the model.
    pub fn global(site: SiteId, tile: TileId, offer: Offer, receivers: &[DeviceId]) -> Self {
        Self::new(site, Destination::Devices(tile), offer, receivers)
    }

    /// Offers a tile of the global model to one device.
    pub fn tile_for(site: SiteId, device: DeviceId, offer: Offer) -> Self {
        Self::new(site, Destination::Device(device), offer, &[device])
    }

    fn new(site: SiteId, destination: Destination, offer: Offer, receivers: &[DeviceId]) -> Self {
        let (chunks, chunk_bytes) = (offer.header.chunks(), offer.header.chunk_bytes);
        let peer = |device: &DeviceId| Peer::new(*device, chunks, chunk_bytes, true);
        Self {
            site,
            destination,
            offer,
            peers: receivers.iter().map(peer).collect(),
            peers_max: DEVICES_MAX,
            signs: true,
            is_full_told: false,
            announce_at: Some(Duration::ZERO),
            announced_at: None,
            backoff: ANNOUNCE,
            broadcast: BitSet::empty(chunks),
            sent_chunks: 0,
            bytes_sent: 0,
            is_cleared: false,
            ask_again_at: Duration::ZERO,
            unanswered: 0,
            told_unanswered: 0,
            renumbered: 0,
            offer_stored_at: None,
            is_stored_offered: false,
            stored_offered_at: None,
        }
    }

    /// Sets the limit on receivers. The required receivers count, but are not limited.
    pub fn with_peers_max(mut self, peers_max: usize) -> Self {
        self.peers_max = peers_max;
        self
    }

    /// Tells that this participant does not sign its messages. Receivers that have a chunk of such a model refuse smaller ones
    /// until no chunk has arrived for a while.
    pub fn unsigned(mut self) -> Self {
        self.signs = false;
        self
    }

    /// The model's key.
    pub fn key(&self) -> ModelKey {
        self.offer.header.into()
    }

    /// The tile of a global model.
    pub fn tile(&self) -> Option<TileId> {
        match self.destination {
            Destination::Aggregator | Destination::Device(_) => None,
            Destination::Devices(tile) => Some(tile),
        }
    }

    /// The device that a tile of the global model is for.
    pub fn device(&self) -> Option<DeviceId> {
        match self.destination {
            Destination::Device(device) => Some(device),
            Destination::Aggregator | Destination::Devices(_) => None,
        }
    }

    /// The progress of the upload.
    pub fn progress(&self) -> UploadProgress {
        let chunks = self.offer.header.chunks();
        let received =
            self.peers.iter().filter(|peer| peer.is_required).map(|peer| peer.chunks_received(chunks));
        let chunks_received = received.min().unwrap_or(chunks);
        let bytes_arrived = u64::from(chunks_received) * u64::from(self.offer.header.chunk_bytes);
        UploadProgress {
            chunks,
            chunks_received,
            bytes_arrived: bytes_arrived.min(self.offer.header.body_bytes),
            bytes_sent: self.bytes_sent,
        }
    }

    /// Whether every required receiver has stored the model or refused it for good.
    pub fn is_closed(&self) -> bool {
        self.peers.iter().all(|peer| !peer.is_required || peer.is_closed())
    }

    /// Whether nothing is left to do. This is never true for a global model, which is offered until another
    /// model replaces it, nor for a device's model that is stored or whose number was refused, because the aggregator may ask
    /// for it again, or this device may give it another number.
    pub fn is_over(&self) -> bool {
        (self.is_cleared && !self.is_kept()) || (self.device().is_some() && self.is_closed())
    }

    /// Whether a device's model is stored or its number was refused. It is kept only for an aggregator that loses it, or for
    /// another number.
    pub(crate) fn is_kept(&self) -> bool {
        let is_number_refused = |peer: &Peer| {
            matches!(peer.phase, PeerPhase::Refused(RefusalReason::NumberTaken | RefusalReason::Replayed))
        };
        self.is_cleared && (self.is_stored() || self.peers.iter().any(is_number_refused))
    }

    /// Repeats the offer, because the transport is connected, and the broker may have lost the offer and the chunks that were on
    /// their way. If hardly a chunk has got through twice in a row, chunks become smaller.
    pub fn on_connected(&mut self, now: Duration) {
        self.peers.iter_mut().for_each(|peer| peer.on_cut(now));
        self.announce_now(now);
        self.on_any_connection(now);
    }

    /// Goes on, because the transport is connected again, and the broker has kept all but these chunks, which are sent again.
    /// Those that the broker has are not: they may wait there for a receiver whose own line is slow. Repeats the offer, but not
    /// to a single receiver that asked for chunks just before: on a line of 5 kB/s that breaks each second, offers and the waits
    /// for their answers took a tenth of the time. If hardly a chunk has got through twice in a row, chunks become smaller.
    pub fn on_resumed(&mut self, now: Duration, lost: &[Topic]) {
        for (index, only) in lost.iter().filter_map(|topic| self.chunk_of(topic)).collect::<Vec<_>>() {
            let its = self.peers.iter_mut().filter(|peer| only.is_none_or(|only| peer.device == only));
            let lost = its.map(|peer| peer.on_lost_chunk(index)).filter(|is_lost| *is_lost).count();
            let message = self.chunk_message(index, only).filter(|_| lost > 0);
            self.bytes_sent -= message.map_or(0, |message| message.bytes() as u64).min(self.bytes_sent);
        }
        let has_one = !matches!(self.destination, Destination::Devices(_));
        if !(has_one && self.peers.iter().all(|peer| peer.knows_offer(now))) {
            self.announce_now(now);
        }
        self.on_any_connection(now);
    }

    /// The index of a chunk that was published under a topic, and its only receiver, if it has one. `None` if it is not a chunk
    /// of this model.
    fn chunk_of(&self, topic: &Topic) -> Option<(u32, Option<DeviceId>)> {
        let ModelKey { device: of, model: its } = self.key();
        match (self.destination, *topic) {
            (Destination::Aggregator, Topic::LocalChunk { device, model, index }) => {
                (device == of && model == its).then_some((index, None))
            }
            (Destination::Devices(to), Topic::GlobalChunk { tile, model, index }) => {
                (tile == to && model == its).then_some((index, None))
            }
            (Destination::Devices(_), Topic::TileChunk { device, model, index }) => {
                (model == its).then_some((index, Some(device)))
            }
            (Destination::Device(to), Topic::TileChunk { device, model, index }) => {
                (device == to && model == its).then_some((index, Some(device)))
            }
            _ => None,
        }
    }

    fn on_any_connection(&mut self, now: Duration) {
        let again_at = self.stored_offered_at.map_or(now, |last| now.max(last + STORED_AGAIN));
        self.offer_stored_at = self.offer_stored_at.map(|at| at.min(again_at));
        if let (Destination::Aggregator, [peer]) = (self.destination, &self.peers[..]) {
            let receiver = peer.device;
            self.shrink_on_poor_line(now, receiver);
        }
    }

    /// Notes a new connection between sender and receiver. Makes chunks smaller if their line is poor.
    fn shrink_on_poor_line(&mut self, now: Duration, receiver: DeviceId) {
        let (chunks, signs) = (self.offer.header.chunks(), self.signs);
        let mut open = self.peers.iter_mut().filter(|peer| !peer.is_closed());
        if open.find(|peer| peer.device == receiver).is_some_and(|peer| peer.on_connected(now, chunks, signs))
        {
            self.set_chunk_bytes(now, (self.offer.header.chunk_bytes / SHRINK).max(CHUNK_BYTES_MIN));
        }
    }

    fn announce_now(&mut self, now: Duration) {
        self.backoff.reset();
        self.announce_at = Some(now);
    }

    /// Repeats the offer of a global model soon, because `device` has begun a session or was reconnected: what the broker
    /// retained for it may have been lost, or deleted by a stranger. If hardly a chunk has reached it twice in a row, chunks
    /// become smaller.
    pub fn on_birth(&mut self, now: Duration, device: DeviceId) {
        if self.tile().is_some() || self.device() == Some(device) {
            if !self.peers.iter().any(|peer| peer.device == device && peer.knows_offer(now)) {
                self.announce_soon(now);
            }
            self.shrink_on_poor_line(now, device);
        }
    }

    /// Repeats the offer of a global model soon, because a device may lack it.
    pub(crate) fn offer_again(&mut self, now: Duration) {
        if self.tile().is_some() {
            self.announce_soon(now);
        }
    }

    /// Plans the next offer for now, or for a while after the last one, however often this is called.
    fn announce_soon(&mut self, now: Duration) {
        let at = self.announced_at.map_or(now, |last| now.max(last + ANNOUNCE_AGAIN));
        self.announce_at = Some(self.announce_at.map_or(at, |planned| planned.min(at)));
    }

    /// Repeats the offer with smaller chunks, because the link accepts at most `max_bytes` per message.
    /// Returns `false` if such chunks would be too small to be useful.
    pub fn shrink_chunks(&mut self, now: Duration, max_bytes: usize) -> bool {
        let overhead = MAX_MESSAGE_BYTES - cosurf_wire::MAX_CHUNK_BYTES + 2 * cosurf_wire::MAX_TOPIC_BYTES;
        let fitting = u32::try_from(max_bytes.saturating_sub(overhead)).unwrap_or(u32::MAX);
        self.set_chunk_bytes(now, fitting.min(self.offer.header.chunk_bytes / 2))
    }

    /// Repeats the offer with chunks of this size. Returns `false` if they would not be smaller than now, or too small to be
    /// useful.
    fn set_chunk_bytes(&mut self, now: Duration, chunk_bytes: u32) -> bool {
        let header = cosurf_wire::ModelHeader { chunk_bytes, ..self.offer.header };
        let is_smaller = (CHUNK_BYTES_MIN..self.offer.header.chunk_bytes).contains(&chunk_bytes);
        if !is_smaller || header.check().is_err() {
            return false;
        }
        let before_bytes = std::mem::replace(&mut self.offer.header, header).chunk_bytes;
        self.broadcast = BitSet::empty(header.chunks());
        for peer in self.peers.iter_mut().filter(|peer| !peer.is_closed()) {
            *peer = peer.with_chunks(header.chunks(), chunk_bytes, before_bytes);
        }
        self.announce_now(now);
        true
    }

    /// Offers a device's model under another number, because the receiver has a model under this or a higher one: the device
    /// has lost its folder. The number of the session, which is the clock's, is higher than those of all earlier models.
    /// After a clock that was ahead, or a stranger's numbers, doubling reaches a higher one soon. Returns `None` if the
    /// model has no other number, or was given too many.
    pub(crate) fn renumber(&mut self, now: Duration, session: u64) -> Option<ModelId> {
        let doubled = self.offer.header.model.0.max(1).checked_mul(2)?;
        let next = ModelId(if self.renumbered == 0 { doubled.max(session) } else { doubled });
        if next.is_tile() || self.renumbered >= RENUMBERED_MAX || self.tile().is_some() {
            return None;
        }
        self.renumbered += 1;
        self.is_cleared = false;
        self.offer.header.model = next;
        let (chunks, chunk_bytes) = (self.offer.header.chunks(), self.offer.header.chunk_bytes);
        for peer in &mut self.peers {
            *peer = Peer::new(peer.device, chunks, chunk_bytes, peer.is_required);
        }
        self.announce_now(now);
        Some(next)
    }

    /// Handles a receiver's reply. Returns `None` if there is nothing to report, for example because the reply
    /// is about another model.
    pub fn on_reply(&mut self, now: Duration, topic: &Topic, message: &Message<'_>) -> Option<UploadEvent> {
        let (by, reply) = self.reply_on(topic)?;
        if replied_model(message) != Some(self.key()) {
            return None;
        }
        if self.is_asked_again(now, message) {
            self.begin_again(now);
            return Some(UploadEvent::AskedAgain(by));
        }
        if self.is_cleared {
            return None;
        }
        let chunks = self.offer.header.chunks();
        let Some(index) = self.peer_index(by, chunks) else {
            let is_first = self.tile().is_some() && !std::mem::replace(&mut self.is_full_told, true);
            return is_first.then_some(UploadEvent::TooManyPeers(by));
        };
        if self.peers[index].is_closed() {
            return self.is_global_lost(now, index, message).then_some(UploadEvent::AskedAgain(by));
        }
        let before = self.peers[index].chunks_received(chunks);
        match (reply, message) {
            (Reply::Want, Message::Want(want)) => {
                if !self.peers[index].on_want(now, chunks, want) {
                    return None;
                }
            }
            (Reply::Done, Message::Done(done)) if done.blake3 == self.offer.header.blake3 => {
                self.peers[index].phase = PeerPhase::Done;
            }
            (Reply::Refused, Message::Refused(refused)) => {
                self.peers[index].on_refused(refused.reason);
                self.unanswered = 0;
                self.on_answer(now);
                return Some(UploadEvent::Refused(by, refused.reason));
            }
            _ => return None,
        }
        self.unanswered = 0;
        self.on_answer(now);
        if self.peers[index].is_required && self.is_stored() {
            return Some(UploadEvent::Finished);
        }
        (self.peers[index].chunks_received(chunks) != before).then_some(UploadEvent::Progress)
    }

    /// Whether the aggregator tells that it has lost a model which it has stored: it lacks all chunks. The time between two
    /// such messages is limited.
    fn is_asked_again(&self, now: Duration, message: &Message<'_>) -> bool {
        let lacks_all = matches!(message, Message::Want(want)
            if (want.idle || self.is_stored_offered) && want.missing == Missing::all());
        let is_local = matches!(self.destination, Destination::Aggregator);
        is_local && lacks_all && self.is_stored() && now >= self.ask_again_at
    }

    /// Whether a device that had the global model has lost it, and gets it again. A tile is offered again by the caller.
    fn is_global_lost(&mut self, now: Duration, index: usize, message: &Message<'_>) -> bool {
        let (Destination::Devices(_), Message::Want(want)) = (self.destination, message) else {
            return false;
        };
        self.peers[index].on_lost(now, self.offer.header.chunks(), want)
    }

    fn begin_again(&mut self, now: Duration) {
        (self.is_cleared, self.is_stored_offered, self.offer_stored_at) = (false, false, None);
        self.ask_again_at = now + ASKED_AGAIN;
        let chunks = self.offer.header.chunks();
        self.peers.iter_mut().for_each(|peer| peer.begin_again(chunks));
        self.announce_now(now);
    }

    /// Returns the next message that is due. The caller must publish it: it counts as sent.
    pub fn next(&mut self, now: Duration) -> Option<Outgoing> {
        self.next_control(now).or_else(|| {
            let is_over = matches!(self.destination, Destination::Aggregator) && self.is_closed();
            let chunk = if is_over { None } else { self.next_chunk(now) };
            chunk.inspect(|chunk| self.bytes_sent += chunk.bytes() as u64)
        })
    }

    /// Like [`Self::next`], without chunks: while the link takes none.
    pub(crate) fn next_control(&mut self, now: Duration) -> Option<Outgoing> {
        let message = match self.destination {
            Destination::Aggregator if self.is_closed() => {
                self.clear_offer(now).or_else(|| self.offer_stored(now))
            }
            _ if self.announce_at.is_some_and(|at| now >= at) => Some(self.announce(now)),
            _ => None,
        };
        message.inspect(|message| self.bytes_sent += message.bytes() as u64)
    }

    /// Time by which [`Self::next`] has a message, if no reply arrives before. `None` if no offer is
    /// scheduled.
    pub fn next_wakeup(&self) -> Option<Duration> {
        if self.is_cleared {
            return self.offer_stored_at;
        }
        let resends = self.peers.iter().filter_map(Peer::next_resend);
        resends.chain(self.announce_at).min()
    }

    /// The number of offers of a device's model without a reply, once it has become large, and again whenever as many more
    /// follow.
    pub(crate) fn take_unanswered(&mut self) -> Option<u32> {
        let is_due = self.unanswered > 0
            && self.unanswered.is_multiple_of(UNANSWERED_OFFERS)
            && self.told_unanswered != self.unanswered
            && matches!(self.destination, Destination::Aggregator);
        is_due.then(|| self.told_unanswered = self.unanswered)?;
        Some(self.unanswered)
    }

    /// Whether a device has ignored the offer of a tile again. Perhaps it has not heard of the manifest.
    pub(crate) fn take_ignored(&mut self) -> bool {
        let is_ignored =
            self.device().is_some() && self.unanswered > 1 && self.told_unanswered != self.unanswered;
        self.told_unanswered = self.unanswered;
        is_ignored
    }

    fn is_stored(&self) -> bool {
        self.peers.iter().all(|peer| !peer.is_required || peer.phase == PeerPhase::Done)
    }

    /// The device and the kind of a reply; `None` if `topic` does not carry replies to this uploader.
    fn reply_on(&self, topic: &Topic) -> Option<(DeviceId, Reply)> {
        match (self.destination, topic) {
            (Destination::Aggregator, Topic::LocalReply { device, reply }) => Some((*device, *reply)),
            (Destination::Devices(_), Topic::GlobalReply { device, reply }) => Some((*device, *reply)),
            (Destination::Device(to), Topic::GlobalReply { device, reply }) if to == *device => {
                Some((to, *reply))
            }
            _ => None,
        }
    }

    /// Index of the peer that replies. If a device replies to a global model for the first time, it becomes a
    /// peer. `None` if the device is no peer and cannot become one.
    fn peer_index(&mut self, device: DeviceId, chunks: u32) -> Option<usize> {
        let known = self.peers.iter().position(|peer| peer.device == device);
        let may_join =
            matches!(self.destination, Destination::Devices(_)) && self.peers.len() < self.peers_max;
        if known.is_none() && may_join {
            self.peers.push(Peer::new(device, chunks, self.offer.header.chunk_bytes, false));
            return Some(self.peers.len() - 1);
        }
        known
    }

    /// Schedules the next offer after a reply. The reply of one device does not tell that the others have heard the offer,
    /// so it does not change the time of the next one.
    fn on_answer(&mut self, now: Duration) {
        if self.is_closed() || !matches!(self.destination, Destination::Devices(_)) {
            self.backoff = ANNOUNCE_ANSWERED;
            self.delay_announcement(now);
        }
    }

    /// Schedules the next offer, in case no reply arrives until then. Schedules none once every required
    /// receiver has stored the model or refused it for good.
    fn delay_announcement(&mut self, now: Duration) {
        self.announce_at = if self.is_closed() { None } else { Some(now + self.backoff.delay()) };
    }

    fn announce(&mut self, now: Duration) -> Outgoing {
        let header = self.offer.header;
        let topic = match self.destination {
            Destination::Aggregator => self.local_topic(),
            Destination::Devices(tile) => Topic::GlobalHeader { tile },
            Destination::Device(device) => Topic::TileHeader { device, model: header.model },
        };
        self.delay_announcement(now);
        self.announced_at = Some(now);
        self.unanswered = self.unanswered.saturating_add(1);
        let is_retained = self.device().is_none();
        Outgoing::new(&self.site, topic, &Message::Header(header), is_retained)
    }

    fn next_chunk(&mut self, now: Duration) -> Option<Outgoing> {
        let index = self.peers.iter().filter_map(|peer| peer.next_chunk(now)).min()?;
        let is_due = |peer: &Peer| peer.next_chunk(now) == Some(index);
        let only = self.only_receiver(index, self.peers.iter().filter(|peer| is_due(peer)));
        self.sent_chunks += 1;
        for peer in self.peers.iter_mut().filter(|peer| only.is_none_or(|only| peer.device == only)) {
            let is_due = is_due(peer);
            peer.on_sent(now, index, self.sent_chunks, is_due);
        }
        if only.is_none() {
            self.broadcast.insert(index);
        }
        self.chunk_message(index, only)
    }

    /// A chunk for all receivers, or only for one of several.
    fn chunk_message(&self, index: u32, only: Option<DeviceId>) -> Option<Outgoing> {
        let header = &self.offer.header;
        let range = header.chunk_range(index)?;
        let payload = &self.offer.body[range.start as usize..range.end as usize];
        let (device, model) = (header.device, header.model);
        let chunk = Chunk { device, model, index, payload };
        let topic = match (self.destination, only) {
            (Destination::Aggregator, _) => Topic::LocalChunk { device, model, index },
            (Destination::Devices(tile), None) => Topic::GlobalChunk { tile, model, index },
            (Destination::Devices(_), Some(device)) | (Destination::Device(device), _) => {
                Topic::TileChunk { device, model, index }
            }
        };
        Some(Outgoing::new(&self.site, topic, &Message::Chunk(chunk), false))
    }

    /// The only device that lacks a chunk which all devices were sent before. `None` if the chunk must be sent to all.
    fn only_receiver<'a>(&self, index: u32, mut lacking: impl Iterator<Item = &'a Peer>) -> Option<DeviceId> {
        let is_again = matches!(self.destination, Destination::Devices(_)) && self.broadcast.contains(index);
        let first = lacking.next().filter(|_| is_again)?.device;
        lacking.next().is_none().then_some(first)
    }

    /// Makes the message that deletes the retained header of a local model, which is no longer needed. Returns
    /// `None` from the second call on.
    fn clear_offer(&mut self, now: Duration) -> Option<Outgoing> {
        if self.is_cleared {
            return None;
        }
        self.is_cleared = true;
        self.offer_stored_at = self.is_stored().then_some(now + STORED_OFFER);
        Some(Outgoing::clear(&self.site, self.local_topic()))
    }

    /// Offers a stored model of a device again, if it is time, in case that the aggregator has lost it. The broker does not
    /// retain the offer.
    fn offer_stored(&mut self, now: Duration) -> Option<Outgoing> {
        self.offer_stored_at.filter(|at| now >= *at)?;
        (self.offer_stored_at, self.is_stored_offered) = (Some(now + STORED_OFFER), true);
        self.stored_offered_at = Some(now);
        Some(Outgoing::new(&self.site, self.local_topic(), &Message::Header(self.offer.header), false))
    }

    fn local_topic(&self) -> Topic {
        Topic::LocalHeader { device: self.key().device, model: self.key().model }
    }
}

/// Key of the model that a receiver's reply is about.
fn replied_model(message: &Message<'_>) -> Option<ModelKey> {
    let (device, model) = match message {
        Message::Want(Want { device, model, .. })
        | Message::Refused(Refused { device, model, .. })
        | Message::Done(Done { device, model, .. }) => (*device, *model),
        Message::Header(_)
        | Message::Chunk(_)
        | Message::State(_)
        | Message::Flight(_)
        | Message::FlightPledge(_)
        | Message::ConfirmedFlights(_)
        | Message::Plan(_) => return None,
    };
    Some(ModelKey { device, model })
}
