//! Decides which messages go to which client, by sessions, subscriptions and retained messages. It uses
//! no socket, thread or clock.

pub(super) mod hello;
mod relief;
mod shared;
mod subscribing;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::BytesMut;
use cosurf_wire::{MAX_MESSAGE_BYTES, MAX_TOPIC_BYTES};
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{
    DisconnectReasonCode, Packet, PubAck, PubAckReason, PubRec, PubRecReason, Publish,
};

use super::access::Access;
use super::client::{Client, User};
use super::filters::Filters;
use super::memory::Budget;
use super::message::{Delivery, Message, cost};
use super::retained::{RETAINED_BYTES, Retained};
use super::session::Session;
use super::subscription::Subscription;
use super::topics::is_topic;

/// Largest packet that the broker accepts, bytes: the largest message of cosurf, and room for the MQTT
/// properties of other programs.
pub(super) const PACKET_BYTES_MAX: usize = MAX_MESSAGE_BYTES + MAX_TOPIC_BYTES + 4096;
/// Limit on the bytes of the messages queued for one client: 256 chunks of 64 KiB.
const QUEUE_BYTES_MAX: usize = 16 << 20;
/// Share of the whole memory that one client's queue may take, as a divisor.
const QUEUE_DIVISOR: usize = 4;

/// How often retained messages that have expired are forgotten. They are not delivered in any case.
const PURGE_EVERY: Duration = Duration::from_secs(10);

/// The whole state of the broker.
#[derive(Debug)]
pub(super) struct Router {
    clients_max: usize,
    budget: Arc<Budget>,
    access: Arc<Access>,
    sessions: BTreeMap<Client, Session>,
    /// The filters of all sessions.
    filters: Filters,
    /// Number of the last session that began.
    last_session: u64,
    links: BTreeMap<usize, Client>,
    retained: Retained,
    /// Client ids of devices that are known to the service: strangers give way to them.
    known: BTreeSet<String>,
    /// Connections with something to write.
    ready: BTreeSet<usize>,
    /// A client of the party whose messages are refused for the moment, because it keeps the most, and until when.
    refusing: Option<(Client, Instant)>,
    /// Messages that were dropped or refused because the memory was full, since the last [`Self::take_lost`].
    lost: u64,
    /// When retained messages that have expired are next forgotten.
    next_purge: Option<Instant>,
    /// Messages of shared subscriptions so far: the clients get them in turn.
    shared: usize,
}

/// How a message was taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Taken {
    /// Queued for all subscribers that have room.
    Queued,
    /// A part of this program subscribes to it and has no room: it must wait.
    Blocked,
}

impl Router {
    /// Makes a router for at most `clients_max` connected clients; its caller refuses further ones.
    pub(super) fn new(clients_max: usize, budget: Arc<Budget>, access: Arc<Access>) -> Self {
        Self {
            clients_max,
            budget,
            access,
            sessions: BTreeMap::new(),
            filters: Filters::default(),
            last_session: 0,
            links: BTreeMap::new(),
            retained: Retained::default(),
            known: BTreeSet::new(),
            ready: BTreeSet::new(),
            refusing: None,
            lost: 0,
            next_purge: None,
            shared: 0,
        }
    }

    /// Remembers the client id of a device that the service knows.
    pub(super) fn know(&mut self, id: String) {
        self.known.insert(id);
    }

    /// Whether a client has a password, a certificate or a device that the service knows.
    pub(super) fn is_known(&self, client: &Client) -> bool {
        *client.user() != User::Stranger || self.known.contains(client.id())
    }

    /// Number of known devices that are not connected.
    pub(super) fn absent_known(&self) -> usize {
        let is_absent = |id: &&String| !self.is_connected(&Client::new(User::Stranger, id));
        self.known.iter().filter(is_absent).count()
    }

    /// Number of connected parts of this program.
    pub(super) fn houses(&self) -> usize {
        self.house_sessions().count()
    }

    /// The sessions of connected parts of this program. They are the last in the order of clients.
    fn house_sessions(&self) -> impl Iterator<Item = (&Client, &Session)> {
        let sessions = self.sessions.range(Client::new(User::House, "")..);
        sessions.filter(|(_, session)| session.link.is_some())
    }

    /// The client of a connection.
    pub(super) fn client(&self, link: usize) -> Option<&Client> {
        self.links.get(&link)
    }

    fn linked(&mut self, link: usize) -> Option<&mut Session> {
        self.sessions.get_mut(self.links.get(&link)?)
    }

    /// Connections that have something to write. Each is returned once.
    pub(super) fn take_ready(&mut self) -> BTreeSet<usize> {
        std::mem::take(&mut self.ready)
    }

    /// Number of messages that were dropped or refused for lack of memory since the last call.
    pub(super) fn take_lost(&mut self) -> u64 {
        std::mem::take(&mut self.lost)
    }

    /// Writes what a connection sends next to `out`, about `bytes_max` bytes at most. Returns whether there is more.
    pub(super) fn write(&mut self, link: usize, now: Instant, bytes_max: usize, out: &mut BytesMut) -> bool {
        let Some(client) = self.links.get(&link) else { return false };
        let Some(session) = self.sessions.get_mut(client) else { return false };
        session.write(now, &self.retained, bytes_max, out);
        session.has_work()
    }

    pub(super) fn answer(&mut self, link: usize, packet: Packet) {
        if let Some(session) = self.linked(link) {
            session.answer(packet);
            self.ready.insert(link);
        }
    }

    pub(super) fn acknowledge(&mut self, link: usize, pkid: u16) {
        if let Some(session) = self.linked(link) {
            session.acknowledge(pkid);
            self.ready.insert(link);
        }
    }

    /// Whether a client sends requests faster than it reads the answers.
    pub(super) fn is_flooded(&mut self, link: usize) -> bool {
        self.linked(link).is_some_and(|session| session.is_flooded())
    }

    /// Number of messages that a connected client has missed because its queue is full.
    pub(super) fn missed(&mut self, link: usize) -> u64 {
        self.linked(link).map_or(0, |session| session.missed)
    }

    /// The reason to refuse a message, if there is one.
    pub(super) fn objection(publish: &Publish) -> Option<DisconnectReasonCode> {
        let properties = publish.properties.as_ref();
        let topic = std::str::from_utf8(&publish.topic).unwrap_or_default();
        match () {
            () if properties.is_some_and(|properties| properties.topic_alias.is_some()) => {
                Some(DisconnectReasonCode::TopicAliasInvalid)
            }
            () if properties.is_some_and(|properties| !properties.subscription_identifiers.is_empty()) => {
                Some(DisconnectReasonCode::ProtocolError)
            }
            () if !is_topic(topic) => Some(DisconnectReasonCode::TopicNameInvalid),
            () => None,
        }
    }

    /// Takes a message from a connection, and acknowledges it if it has QoS 1 or 2. If a part of this program subscribes to
    /// it and has no room, nothing happens unless `is_urgent`: the part then misses the message.
    pub(super) fn receive(&mut self, link: usize, now: Instant, publish: &Publish, is_urgent: bool) -> Taken {
        let Some(client) = self.links.get(&link).cloned() else { return Taken::Queued };
        if publish.qos == QoS::ExactlyOnce && self.is_copy(link, publish.pkid) {
            self.answer(link, Packet::PubRec(PubRec::new(publish.pkid, None)));
            return Taken::Queued;
        }
        if !is_urgent && self.is_house_full(&client, publish) {
            return Taken::Blocked;
        }
        let reason = self.publish(&client, now, publish);
        let pkid = publish.pkid;
        match publish.qos {
            QoS::AtMostOnce => {}
            QoS::AtLeastOnce => self.answer(link, Packet::PubAck(PubAck { pkid, reason, properties: None })),
            QoS::ExactlyOnce => self.take(link, pkid, reason),
        }
        Taken::Queued
    }

    fn is_copy(&mut self, link: usize, pkid: u16) -> bool {
        self.linked(link).is_some_and(|session| session.handshakes.is_copy(pkid))
    }

    /// Acknowledges a message of QoS 2, and remembers its id unless the message was refused.
    fn take(&mut self, link: usize, pkid: u16, reason: PubAckReason) {
        let reason = match reason {
            PubAckReason::NotAuthorized => PubRecReason::NotAuthorized,
            PubAckReason::QuotaExceeded => PubRecReason::QuotaExceeded,
            PubAckReason::TopicNameInvalid => PubRecReason::TopicNameInvalid,
            PubAckReason::NoMatchingSubscribers => PubRecReason::NoMatchingSubscribers,
            _ => PubRecReason::Success,
        };
        let is_taken = matches!(reason, PubRecReason::Success | PubRecReason::NoMatchingSubscribers);
        if let Some(session) = self.linked(link).filter(|_| is_taken) {
            session.handshakes.take(pkid);
        }
        self.answer(link, Packet::PubRec(PubRec { pkid, reason, properties: None }));
    }

    /// Handles PUBREL: the client will not send this message of QoS 2 again.
    pub(super) fn complete(&mut self, link: usize, pkid: u16) {
        let answer = self.linked(link).map(|session| session.handshakes.complete(pkid));
        answer.into_iter().for_each(|answer| self.answer(link, Packet::PubComp(answer)));
    }

    /// Handles PUBREC: the client has taken a message of QoS 2, or refuses it.
    pub(super) fn release(&mut self, link: usize, pkid: u16, is_taken: bool) {
        if let Some(session) = self.linked(link) {
            session.release(pkid, is_taken);
            self.ready.insert(link);
        }
    }

    /// Handles PUBCOMP: a message of QoS 2 is finished.
    pub(super) fn finish(&mut self, link: usize, pkid: u16) {
        if let Some(session) = self.linked(link) {
            session.handshakes.finish(pkid);
            session.weigh();
            self.ready.insert(link);
        }
    }

    /// Number of messages of QoS 2 that the client has sent and not released.
    pub(super) fn unreleased(&mut self, link: usize) -> usize {
        self.linked(link).map_or(0, |session| session.handshakes.taken())
    }

    /// Whether a part of this program subscribes to a message and has no room for it. No other subscriber makes a
    /// publisher wait.
    fn is_house_full(&self, client: &Client, publish: &Publish) -> bool {
        let topic = std::str::from_utf8(&publish.topic).unwrap_or_default();
        self.house_sessions().any(|(receiver, session)| {
            session.is_full(cost(publish)) && session.wants(topic, receiver == client).is_some()
        })
    }

    /// Queues a message for all subscribers of its topic, and stores it if it is retained. Subscribers
    /// without room miss it. Returns the reason code for the publisher.
    fn publish(&mut self, client: &Client, now: Instant, publish: &Publish) -> PubAckReason {
        let Ok(topic) = std::str::from_utf8(&publish.topic) else { return PubAckReason::TopicNameInvalid };
        if !self.access.may_publish(client.user(), topic) {
            return PubAckReason::NotAuthorized;
        }
        // A message that removes a retained one is never refused.
        let removes = publish.retain && publish.payload.is_empty();
        if !self.make_room(client, now, cost(publish) + RETAINED_BYTES) && !removes {
            self.lost += 1;
            return PubAckReason::QuotaExceeded;
        }
        let message = Arc::new(Message::new(&self.budget, now, topic, publish));
        let is_heard = self.deliver(client, publish, &message);
        if removes {
            self.retained.remove(topic);
        } else if publish.retain {
            self.retained.put(&self.budget, client, message, publish.qos);
        }
        if is_heard { PubAckReason::Success } else { PubAckReason::NoMatchingSubscribers }
    }

    /// Queues a message for its subscribers; returns whether there are any.
    fn deliver(&mut self, client: &Client, publish: &Publish, message: &Arc<Message>) -> bool {
        let mut is_heard = false;
        let interested = self.filters.matching(message.topic());
        for receiver in &interested {
            let Some(session) = self.sessions.get_mut(receiver) else { continue };
            let Some(subscription) = session.wants(message.topic(), receiver == client) else { continue };
            is_heard = true;
            let (qos, keeps_retain) = (subscription.qos, subscription.keeps_retain);
            self.ready.extend(enqueue(session, message, publish, qos, keeps_retain));
        }
        self.deliver_shared(publish, message, &interested) || is_heard
    }

    /// Publishes the last wills whose time has come, and forgets sessions and messages that have expired.
    pub(super) fn tick(&mut self, now: Instant) {
        self.publish_wills(now);
        self.forget_expired(now);
        if self.next_purge.is_none_or(|at| at <= now) {
            self.retained.drop_expired(now);
            self.next_purge = Some(now + PURGE_EVERY);
        }
    }

    fn publish_wills(&mut self, now: Instant) {
        let is_due = |session: &Session| session.will.as_ref().is_some_and(|(at, _)| *at <= now);
        let due = self.sessions.iter_mut().filter(|(_, session)| is_due(session));
        let wills: Vec<(Client, Publish)> =
            due.filter_map(|(client, session)| Some((client.clone(), session.will.take()?.1))).collect();
        for (client, will) in wills {
            self.publish(&client, now, &will);
        }
    }

    /// Removes a session and its filters.
    fn remove_session(&mut self, client: &Client) -> Option<Session> {
        let session = self.sessions.remove(client)?;
        let filters = session.subscriptions.iter().map(Subscription::filter);
        filters.for_each(|filter| self.filters.remove(filter, session.number));
        Some(session)
    }

    /// Drops a session. A last will that waits is published.
    fn end_session(&mut self, client: &Client, now: Instant) {
        let will = self.remove_session(client).and_then(|session| session.will);
        if let Some((_, will)) = will {
            self.publish(client, now, &will);
        }
    }

    fn forget_expired(&mut self, now: Instant) {
        let is_over = |session: &Session| session.expires.is_some_and(|at| at <= now);
        let over = self.sessions.iter().filter(|(_, session)| is_over(session));
        let over: Vec<Client> = over.map(|(client, _)| client.clone()).collect();
        over.iter().for_each(|client| self.end_session(client, now));
    }
}

/// The time at which something that lasts `seconds` from `now` ends.
fn after(now: Instant, seconds: u32) -> Instant {
    now + Duration::from_secs(u64::from(seconds))
}

fn lower(a: QoS, b: QoS) -> QoS {
    if (a as u8) < (b as u8) { a } else { b }
}

/// Queues a message for a client, unless there is no room; returns the client's connection.
fn enqueue(
    session: &mut Session,
    message: &Arc<Message>,
    publish: &Publish,
    qos: QoS,
    keeps_retain: bool,
) -> Option<usize> {
    if session.is_full(message.bytes()) {
        session.missed += 1;
        return None;
    }
    let (qos, retain) = (lower(publish.qos, qos), publish.retain && keeps_retain);
    session.enqueue(Delivery { message: Arc::clone(message), qos, retain, dup: false, pkid: 0 });
    session.link.as_ref().map(|link| link.id)
}
