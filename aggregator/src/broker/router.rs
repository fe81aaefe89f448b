//! Decides which messages go to which client, by sessions, subscriptions and retained messages. It uses
//! no socket, thread or clock.

use std::collections::BTreeMap;
use std::sync::{Arc, Condvar};
use std::time::{Duration, Instant};

use cosurf_wire::{MAX_MESSAGE_BYTES, MAX_TOPIC_BYTES};
use rumqttc::v5::mqttbytes::v5::{
    ConnAck, ConnAckProperties, Connect, ConnectReturnCode, DisconnectReasonCode, Filter, LastWill, Packet,
    PubAck, PubAckReason, Publish, RetainForwardRule, SubAck, Subscribe, SubscribeReasonCode, UnsubAck,
    UnsubAckReason, Unsubscribe,
};
use rumqttc::v5::mqttbytes::{QoS, matches, valid_filter, valid_topic};

use super::session::{FILTERS_MAX, Link, Session, bytes_of};

/// Largest packet that the broker accepts, bytes: the largest message of cosurf, and room for the MQTT
/// properties of other programs.
pub(super) const PACKET_BYTES_MAX: u32 = (MAX_MESSAGE_BYTES + MAX_TOPIC_BYTES + 4096) as u32;
/// Limit on sessions for each client that may be connected. Sessions outlive connections. When the limit is reached, the
/// disconnected session that expires first is dropped.
const SESSIONS_PER_CLIENT: usize = 2;
/// Longest time that a session outlives its connection, seconds.
const SESSION_EXPIRY_S_MAX: u32 = 24 * 3600;
/// Limit on retained messages for each client that may be connected.
const RETAINED_PER_CLIENT: usize = 8;
/// Limit on the bytes of the topics and payloads of all retained messages together.
const RETAINED_BYTES_MAX: usize = 64 << 20;
/// Limit on QoS 1 messages that one client has not acknowledged.
const IN_FLIGHT_MAX: u16 = 64;
/// Longest client id, topic and topic filter, bytes: four times the longest device id.
const TEXT_BYTES_MAX: usize = 256;

/// The whole state of the broker.
#[derive(Debug)]
pub(super) struct Router {
    clients_max: usize,
    sessions: BTreeMap<String, Session>,
    retained: BTreeMap<String, Publish>,
    retained_bytes: usize,
    links: u64,
}

/// Identifies one connection of a client.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct LinkKey {
    client: String,
    id: u64,
}

impl Router {
    /// Makes a router for at most `clients_max` connected clients; its caller refuses further ones.
    pub(super) fn new(clients_max: usize) -> Self {
        let (sessions, retained) = (BTreeMap::new(), BTreeMap::new());
        Self { clients_max, sessions, retained, retained_bytes: 0, links: 0 }
    }

    /// Connects a client, and closes an older connection with the same client id. An error is the
    /// reason for a refusal.
    pub(super) fn connect(
        &mut self,
        now: Instant,
        connect: Connect,
        will: Option<LastWill>,
    ) -> Result<(LinkKey, Arc<Condvar>), ConnectReturnCode> {
        if connect.client_id.len() > TEXT_BYTES_MAX {
            return Err(ConnectReturnCode::ClientIdentifierNotValid);
        }
        self.links += 1;
        let id = self.links;
        let assigned = connect.client_id.is_empty().then(|| format!("client-{id}"));
        let client = assigned.clone().unwrap_or(connect.client_id);
        self.take_over(&client, connect.clean_start);
        self.forget_expired(now);
        let session_present = self.sessions.contains_key(&client);
        let wishes = connect.properties.unwrap_or_default();
        let work = Arc::new(Condvar::new());
        let mut link = Link::new(id, Arc::clone(&work));
        link.receive_max = usize::from(wishes.receive_maximum.unwrap_or(u16::MAX).clamp(1, IN_FLIGHT_MAX));
        link.packet_bytes_max = wishes.max_packet_size.map_or(usize::MAX, |bytes| bytes as usize);
        link.expiry_s = wishes.session_expiry_interval.unwrap_or(0).min(SESSION_EXPIRY_S_MAX);
        link.will = will;
        let ack = connack(session_present, link.expiry_s, assigned);
        let session = self.sessions.entry(client.clone()).or_default();
        session.expires = None;
        session.link = Some(link);
        session.answer(Packet::ConnAck(ack));
        Ok((LinkKey { client, id }, work))
    }

    /// Ends a connection. Publishes the client's last will, unless `is_graceful` says that the client ended the
    /// connection with a normal DISCONNECT.
    pub(super) fn disconnect(&mut self, now: Instant, key: &LinkKey, is_graceful: bool) {
        let Some(session) = self.linked(key) else { return };
        let Some(link) = session.link.take() else { return };
        session.unlink();
        if link.expiry_s == 0 {
            self.sessions.remove(&key.client);
        } else {
            session.expires = Some(now + Duration::from_secs(u64::from(link.expiry_s)));
        }
        if let Some(will) = link.will.filter(|_| !is_graceful) {
            let (topic, payload) = (will.topic, will.message);
            let publish =
                Publish { qos: will.qos, retain: will.retain, topic, payload, ..Publish::default() };
            self.publish(key, publish);
        }
    }

    /// Makes the writer thread of a connection send DISCONNECT and end the connection.
    pub(super) fn close(&mut self, key: &LinkKey, reason: DisconnectReasonCode) {
        if let Some(link) = self.linked(key).and_then(|session| session.link.as_mut()) {
            link.closing = Some(reason);
            link.work.notify_one();
        }
    }

    /// Makes the writer threads of all connections send DISCONNECT and end their connections.
    pub(super) fn close_all(&mut self, reason: DisconnectReasonCode) {
        for link in self.sessions.values_mut().filter_map(|session| session.link.as_mut()) {
            link.closing = Some(reason);
            link.work.notify_one();
        }
    }

    pub(super) fn answer(&mut self, key: &LinkKey, packet: Packet) {
        if let Some(session) = self.linked(key) {
            session.answer(packet);
        }
    }

    pub(super) fn acknowledge(&mut self, key: &LinkKey, pkid: u16) {
        if let Some(session) = self.linked(key) {
            session.acknowledge(pkid);
        }
    }

    /// Adds subscriptions of a client, then queues the retained messages that match them.
    pub(super) fn subscribe(&mut self, key: &LinkKey, subscribe: Subscribe) {
        let retained: Vec<_> =
            subscribe.filters.iter().map(|filter| self.retained_for(key, filter)).collect();
        let Some(session) = self.linked(key) else { return };
        let mut codes = Vec::with_capacity(subscribe.filters.len());
        let mut waiting = Vec::new();
        for (filter, retained) in subscribe.filters.into_iter().zip(retained) {
            let code = add_filter(session, filter);
            if let SubscribeReasonCode::Success(_) = code {
                waiting.extend(retained);
            }
            codes.push(code);
        }
        session.answer(Packet::SubAck(SubAck {
            pkid: subscribe.pkid,
            return_codes: codes,
            properties: None,
        }));
        waiting.into_iter().for_each(|publish| session.enqueue(publish));
    }

    pub(super) fn unsubscribe(&mut self, key: &LinkKey, unsubscribe: Unsubscribe) {
        let Some(session) = self.linked(key) else { return };
        let mut reasons = Vec::with_capacity(unsubscribe.filters.len());
        for path in unsubscribe.filters {
            let before = session.filters.len();
            session.filters.retain(|filter| filter.path != path);
            reasons.push(match session.filters.len() < before {
                true => UnsubAckReason::Success,
                false => UnsubAckReason::NoSubscriptionExisted,
            });
        }
        let ack = UnsubAck { pkid: unsubscribe.pkid, reasons, properties: None };
        session.answer(Packet::UnsubAck(ack));
    }

    /// The reason to refuse a message, if there is one.
    pub(super) fn objection(publish: &Publish) -> Option<DisconnectReasonCode> {
        let topic = std::str::from_utf8(&publish.topic).unwrap_or_default();
        let has_alias =
            publish.properties.as_ref().is_some_and(|properties| properties.topic_alias.is_some());
        match () {
            () if publish.qos == QoS::ExactlyOnce => Some(DisconnectReasonCode::QoSNotSupported),
            () if has_alias => Some(DisconnectReasonCode::TopicAliasInvalid),
            () if topic.is_empty() || topic.len() > TEXT_BYTES_MAX || !valid_topic(topic) => {
                Some(DisconnectReasonCode::TopicNameInvalid)
            }
            () => None,
        }
    }

    /// Whether the publisher of a message must wait, because a connected subscriber has no room for the
    /// message. Stalled subscribers do not count.
    pub(super) fn is_blocked(&self, key: &LinkKey, publish: &Publish) -> bool {
        self.receivers(key, publish).any(|session| {
            session.link.is_some() && !session.is_stalled && session.is_full(bytes_of(publish))
        })
    }

    /// Marks subscribers without room for a message as stalled: publishers no longer wait for them.
    pub(super) fn give_up_on_blocking(&mut self, key: &LinkKey, publish: &Publish) {
        let topic = std::str::from_utf8(&publish.topic).unwrap_or_default();
        for (client, session) in &mut self.sessions {
            let is_receiver = session.wants(topic, *client == key.client).is_some();
            session.is_stalled |= is_receiver && session.is_full(bytes_of(publish));
        }
    }

    /// Queues a message for all subscribers of its topic, and stores it if it is retained. Subscribers
    /// without room miss it. Returns the reason code for the publisher.
    pub(super) fn publish(&mut self, key: &LinkKey, publish: Publish) -> PubAckReason {
        let Ok(topic) = std::str::from_utf8(&publish.topic) else { return PubAckReason::TopicNameInvalid };
        let mut is_heard = false;
        for (client, session) in &mut self.sessions {
            let Some(filter) = session.wants(topic, *client == key.client) else { continue };
            is_heard = true;
            let (qos, retain) = (lower(publish.qos, filter.qos), publish.retain && filter.preserve_retain);
            if !session.is_full(bytes_of(&publish)) {
                session.enqueue(Publish { qos, retain, dup: false, pkid: 0, ..publish.clone() });
            }
        }
        if publish.retain && !self.retain(publish) {
            return PubAckReason::QuotaExceeded;
        }
        if is_heard { PubAckReason::Success } else { PubAckReason::NoMatchingSubscribers }
    }

    /// Acknowledges a QoS 1 message to its publisher.
    pub(super) fn answer_publish(&mut self, key: &LinkKey, pkid: u16, reason: PubAckReason) {
        let mut ack = PubAck::new(pkid, None);
        ack.reason = reason;
        self.answer(key, Packet::PubAck(ack));
    }

    /// Returns what the writer thread of a connection does next, with about `bytes_max` bytes of messages at most.
    pub(super) fn take(&mut self, key: &LinkKey, bytes_max: usize) -> Work {
        let Some(session) = self.linked(key) else {
            let is_taken_over = self.sessions.get(&key.client).is_some_and(|session| session.link.is_some());
            return Work::End(is_taken_over.then_some(DisconnectReasonCode::SessionTakenOver));
        };
        let packets = session.take(bytes_max);
        let closing = session.link.as_ref().and_then(|link| link.closing);
        match (packets.is_empty(), closing) {
            (false, _) => Work::Write(packets),
            (true, Some(reason)) => Work::End(Some(reason)),
            (true, None) => Work::Wait,
        }
    }

    /// Whether a client sends requests faster than it reads the answers.
    pub(super) fn is_flooded(&mut self, key: &LinkKey) -> bool {
        self.linked(key).is_some_and(|session| session.is_flooded())
    }

    /// Whether a connection is still its client's current one.
    pub(super) fn is_linked(&mut self, key: &LinkKey) -> bool {
        self.linked(key).is_some()
    }

    fn linked(&mut self, key: &LinkKey) -> Option<&mut Session> {
        let session = self.sessions.get_mut(&key.client)?;
        let is_current = session.link.as_ref().is_some_and(|link| link.id == key.id);
        is_current.then_some(session)
    }

    /// Closes a client's older connection; `clean_start` also drops its session.
    fn take_over(&mut self, client: &str, clean_start: bool) {
        let Some(session) = self.sessions.get_mut(client) else { return };
        if let Some(link) = session.link.take() {
            // The writer thread of that connection finds that its link is gone, and ends.
            link.work.notify_one();
            session.unlink();
        }
        if clean_start {
            self.sessions.remove(client);
        }
    }

    fn forget_expired(&mut self, now: Instant) {
        self.sessions.retain(|_, session| session.expires.is_none_or(|at| now < at));
        while self.sessions.len() >= SESSIONS_PER_CLIENT * self.clients_max {
            let away = self.sessions.iter().filter_map(|(client, session)| Some((session.expires?, client)));
            let Some(client) = away.min().map(|(_, client)| client.clone()) else { break };
            self.sessions.remove(&client);
        }
    }

    fn receivers(&self, key: &LinkKey, publish: &Publish) -> impl Iterator<Item = &Session> {
        let topic = std::str::from_utf8(&publish.topic).unwrap_or_default();
        let wants = move |(client, session): &(&String, &Session)| {
            session.wants(topic, **client == key.client).is_some()
        };
        self.sessions.iter().filter(wants).map(|(_, session)| session)
    }

    /// Stores a message as the retained message of its topic; an empty message removes the stored one. Returns
    /// `false` if there is no room.
    fn retain(&mut self, publish: Publish) -> bool {
        let topic = String::from_utf8_lossy(&publish.topic).into_owned();
        let old = self.retained.get(&topic).map_or(0, bytes_of);
        if publish.payload.is_empty() {
            self.retained.remove(&topic);
            self.retained_bytes -= old;
            return true;
        }
        let bytes = self.retained_bytes - old + bytes_of(&publish);
        let count = self.retained.len() + usize::from(old == 0);
        if bytes > RETAINED_BYTES_MAX || count > RETAINED_PER_CLIENT * self.clients_max {
            return false;
        }
        self.retained_bytes = bytes;
        self.retained.insert(topic, Publish { dup: false, pkid: 0, ..publish });
        true
    }

    /// The retained messages that a subscription asks for.
    fn retained_for(&self, key: &LinkKey, filter: &Filter) -> Vec<Publish> {
        let has_it = self
            .sessions
            .get(&key.client)
            .is_some_and(|session| session.filters.iter().any(|old| old.path == filter.path));
        let is_asked = match filter.retain_forward_rule {
            RetainForwardRule::OnEverySubscribe => true,
            RetainForwardRule::OnNewSubscribe => !has_it,
            RetainForwardRule::Never => false,
        };
        let kept = self.retained.iter().filter(|(topic, _)| is_asked && matches(topic, &filter.path));
        kept.map(|(_, publish)| Publish { qos: lower(publish.qos, filter.qos), ..publish.clone() }).collect()
    }
}

/// What the writer thread of a connection does next.
#[derive(Debug)]
pub(super) enum Work {
    Write(Vec<Packet>),
    Wait,
    /// End the connection, with DISCONNECT if there is a reason.
    End(Option<DisconnectReasonCode>),
}

fn lower(a: QoS, b: QoS) -> QoS {
    if (a as u8) < (b as u8) { a } else { b }
}

fn add_filter(session: &mut Session, mut filter: Filter) -> SubscribeReasonCode {
    if filter.path.len() > TEXT_BYTES_MAX || !valid_filter(&filter.path) {
        return SubscribeReasonCode::TopicFilterInvalid;
    }
    if filter.path.starts_with("$share/") {
        return SubscribeReasonCode::SharedSubscriptionsNotSupported;
    }
    session.filters.retain(|old| old.path != filter.path);
    if session.filters.len() >= FILTERS_MAX {
        return SubscribeReasonCode::QuotaExceeded;
    }
    filter.qos = lower(filter.qos, QoS::AtLeastOnce);
    let granted = filter.qos;
    session.filters.push(filter);
    SubscribeReasonCode::Success(granted)
}

/// CONNACK with the limits and features of this broker.
fn connack(session_present: bool, expiry_s: u32, assigned: Option<String>) -> ConnAck {
    let properties = ConnAckProperties {
        session_expiry_interval: Some(expiry_s),
        receive_max: Some(IN_FLIGHT_MAX),
        max_qos: Some(1),
        retain_available: Some(1),
        max_packet_size: Some(PACKET_BYTES_MAX),
        assigned_client_identifier: assigned,
        topic_alias_max: Some(0),
        reason_string: None,
        user_properties: Vec::new(),
        wildcard_subscription_available: Some(1),
        subscription_identifiers_available: Some(0),
        shared_subscription_available: Some(0),
        server_keep_alive: None,
        response_information: None,
        server_reference: None,
        authentication_method: None,
        authentication_data: None,
    };
    ConnAck { session_present, code: ConnectReturnCode::Success, properties: Some(properties) }
}
