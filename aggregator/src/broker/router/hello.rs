//! How connections begin and end.

use std::time::Instant;

use rumqttc::v5::mqttbytes::v5::{
    ConnAck, ConnAckProperties, ConnectProperties, ConnectReturnCode, Packet, Publish,
};

use super::super::client::{Client, User};
use super::super::message::will_message;
use super::super::packet::{Hello, Version};
use super::super::session::{Link, Session};
use super::super::topics::TEXT_BYTES_MAX;
use super::{PACKET_BYTES_MAX, QUEUE_BYTES_MAX, QUEUE_DIVISOR, Router, after};

/// Longest time that a session outlives its connection, seconds.
const SESSION_EXPIRY_S_MAX: u32 = 24 * 3600;
/// Limit on messages with QoS 1 or 2 that one side has not acknowledged.
pub(in super::super) const IN_FLIGHT_MAX: u16 = 64;
/// Longest keep-alive, seconds. A client that asks for a longer one, or for none, is told this one.
pub(in super::super) const KEEP_ALIVE_S_MAX: u16 = 600;

/// The name of the client that says hello. An error is the reason for a refusal.
pub(in super::super) fn name(hello: &Hello, user: User, link: usize) -> Result<Client, ConnectReturnCode> {
    let id = hello.connect.client_id.as_str();
    let is_lasting = hello.version == Version::V3 && !hello.connect.clean_start;
    if id.len() > TEXT_BYTES_MAX || id.contains('\0') || (id.is_empty() && is_lasting) {
        return Err(ConnectReturnCode::ClientIdentifierNotValid);
    }
    Ok(if id.is_empty() { Client::new(user, &format!("client-{link}")) } else { Client::new(user, id) })
}

impl Router {
    /// Whether a client is connected: a new connection takes the place of that one.
    pub(in super::super) fn is_connected(&self, client: &Client) -> bool {
        self.sessions.get(client).is_some_and(|session| session.link.is_some())
    }

    /// Connects a client. Returns the older connection with the same name, which the caller must close. An error is the
    /// reason for a refusal.
    pub(in super::super) fn connect(
        &mut self,
        link_id: usize,
        now: Instant,
        client: &Client,
        hello: Hello,
    ) -> Result<Option<usize>, ConnectReturnCode> {
        let will_delay_s = hello.will.as_ref().and_then(|will| will.properties.as_ref()?.delay_interval);
        let will = hello.will.map(will_message);
        if will.as_ref().is_some_and(|will| Self::objection(will).is_some()) {
            return Err(ConnectReturnCode::TopicNameInvalid);
        }
        let older = self.take_over(client, now, hello.connect.clean_start);
        let session_present = self.sessions.contains_key(client);
        if !session_present {
            self.forget_excess(client, now);
            self.last_session += 1;
        }
        let wishes = hello.connect.properties.unwrap_or_default();
        let mut link = Link::new(link_id, hello.version);
        link.receive_max = usize::from(wishes.receive_maximum.unwrap_or(u16::MAX).clamp(1, IN_FLIGHT_MAX));
        link.packet_bytes_max = wishes.max_packet_size.map_or(usize::MAX, |bytes| bytes as usize);
        link.expiry_s = wishes.session_expiry_interval.unwrap_or(0).min(SESSION_EXPIRY_S_MAX);
        (link.will, link.will_delay_s) = (will, will_delay_s.unwrap_or(0));
        let assigned = hello.connect.client_id.is_empty().then(|| client.id().to_owned());
        let ack = connack(session_present, &wishes, link.expiry_s, hello.connect.keep_alive, assigned);
        let queue_bytes_max = QUEUE_BYTES_MAX.min(self.budget.max() / QUEUE_DIVISOR);
        let new = || Session::new(&self.budget, queue_bytes_max, self.last_session);
        let session = self.sessions.entry(client.clone()).or_insert_with(new);
        (session.expires, session.will) = (None, None);
        session.link = Some(link);
        self.links.insert(link_id, client.clone());
        self.answer(link_id, Packet::ConnAck(ack));
        self.linked(link_id).into_iter().for_each(Session::resume);
        Ok(older)
    }

    /// Ends a client's older connection and publishes its last will; `clean_start` also drops its session.
    fn take_over(&mut self, client: &Client, now: Instant, clean_start: bool) -> Option<usize> {
        let session = self.sessions.get_mut(client)?;
        let older = session.link.as_ref().map(|link| link.id);
        if let Some(link) = older {
            self.disconnect(link, now, false);
        }
        if clean_start && self.sessions.contains_key(client) {
            self.end_session(client, now);
        }
        older
    }

    /// Ends a connection. Publishes the client's last will, unless `is_graceful` says that the client ended the
    /// connection with a normal DISCONNECT.
    pub(in super::super) fn disconnect(&mut self, link: usize, now: Instant, is_graceful: bool) {
        let Some(client) = self.links.remove(&link) else { return };
        let Some(session) = self.sessions.get_mut(&client) else { return };
        let Some(link) = session.unlink() else { return };
        let will = link.will.filter(|_| !is_graceful);
        let will: Option<Publish> = match will {
            Some(will) if link.will_delay_s.min(link.expiry_s) > 0 => {
                session.will = Some((after(now, link.will_delay_s.min(link.expiry_s)), will));
                None
            }
            will => will,
        };
        session.expires = Some(after(now, link.expiry_s));
        session.weigh();
        if link.expiry_s == 0 {
            self.remove_session(&client);
        }
        if let Some(will) = will {
            self.publish(&client, now, &will);
        }
    }

    /// Changes how long a session outlives its connection, as a client's DISCONNECT may ask. False if the client must
    /// not ask for it: a session that was to end with its connection cannot be prolonged.
    pub(in super::super) fn set_expiry(&mut self, link: usize, seconds: u32) -> bool {
        let Some(link) = self.linked(link).and_then(|session| session.link.as_mut()) else { return true };
        if link.expiry_s == 0 && seconds > 0 {
            return false;
        }
        link.expiry_s = seconds.min(SESSION_EXPIRY_S_MAX);
        true
    }
}

/// The keep-alive that the broker demands instead of the one that a client asks for; `None` if that one is fine.
fn other_keep_alive(asked_s: u16) -> Option<u16> {
    (asked_s == 0 || asked_s > KEEP_ALIVE_S_MAX).then_some(KEEP_ALIVE_S_MAX)
}

/// CONNACK with the limits and features of this broker.
fn connack(
    session_present: bool,
    wishes: &ConnectProperties,
    expiry_s: u32,
    keep_alive_s: u16,
    assigned: Option<String>,
) -> ConnAck {
    let is_changed = wishes.session_expiry_interval.unwrap_or(0) != expiry_s;
    let properties = ConnAckProperties {
        session_expiry_interval: is_changed.then_some(expiry_s),
        receive_max: Some(IN_FLIGHT_MAX),
        // Absent for QoS 2.
        max_qos: None,
        retain_available: Some(1),
        max_packet_size: Some(PACKET_BYTES_MAX as u32),
        assigned_client_identifier: assigned,
        topic_alias_max: Some(0),
        reason_string: None,
        user_properties: Vec::new(),
        wildcard_subscription_available: Some(1),
        subscription_identifiers_available: Some(1),
        shared_subscription_available: Some(1),
        server_keep_alive: other_keep_alive(keep_alive_s),
        response_information: None,
        server_reference: None,
        authentication_method: None,
        authentication_data: None,
    };
    ConnAck { session_present, code: ConnectReturnCode::Success, properties: Some(properties) }
}
