//! What a client connects to, and the limits that its two threads share.

use std::fmt;

use cosurf_wire::{MAX_MESSAGE_BYTES, MAX_TOPIC_BYTES};
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{self, Connect, ConnectProperties, Filter, LastWill, Packet, Subscribe};

use super::address::BrokerAddress;
use super::session::SUBSCRIBE_ID;
use super::tls::Tls;
use crate::transport::Outgoing;

/// Maximum number of events that wait for the caller: 64 chunks of 64 KiB are 4 MiB. If the caller computes
/// for too long, further messages are dropped, and the protocol requests them again.
pub(super) const EVENTS_MAX: usize = 64;
/// Usual number of messages that the broker may send before the client has acknowledged one.
pub(super) const RECEIVE_MAX: u16 = EVENTS_MAX as u16 / 2;
/// Upper bound on the bytes of a publish packet besides topic and payload.
pub(super) const PACKET_OVERHEAD_BYTES: usize = 16;
/// Largest packet that a client accepts, in bytes.
pub(super) const PACKET_BYTES_MAX: usize = MAX_MESSAGE_BYTES + MAX_TOPIC_BYTES + PACKET_OVERHEAD_BYTES;
/// What a client connects to, and as whom.
#[derive(Clone, Debug)]
pub(super) struct ClientSettings {
    pub(super) broker: BrokerAddress,
    pub(super) tls: Option<Tls>,
    pub(super) login: Option<Login>,
    pub(super) client_id: String,
    /// How long the broker keeps the session of this client while it is away, seconds; 0 for no longer than the
    /// connection.
    pub(super) session_expiry_s: u32,
    /// How many messages the broker may send before the client has acknowledged one.
    pub(super) receive_max: u16,
    pub(super) will: Option<Outgoing>,
    pub(super) filters: Vec<Filter>,
}

/// Interval in which at least one packet is sent. The broker detects a dead connection within one and a half
/// intervals, the client within two.
pub(super) const KEEP_ALIVE_S: u16 = 30;

impl ClientSettings {
    /// The SUBSCRIBE packet for all filters.
    pub(super) fn subscription(&self) -> Packet {
        let mut subscribe = Subscribe::new_many(self.filters.iter().cloned(), None);
        subscribe.pkid = SUBSCRIBE_ID;
        Packet::Subscribe(subscribe)
    }

    /// The CONNECT packet. If `is_anew`, the broker drops the session that it has kept.
    pub(super) fn hello(&self, is_anew: bool) -> Packet {
        let properties = ConnectProperties {
            session_expiry_interval: Some(self.session_expiry_s),
            receive_maximum: Some(self.receive_max),
            max_packet_size: Some(PACKET_BYTES_MAX as u32),
            ..ConnectProperties::new()
        };
        let connect = Connect {
            keep_alive: KEEP_ALIVE_S,
            client_id: self.client_id.clone(),
            clean_start: is_anew || self.session_expiry_s == 0,
            properties: Some(properties),
        };
        let will = self.will.clone().map(|Outgoing { topic, payload, retain }| {
            LastWill::new(topic.as_str(), payload, QoS::AtLeastOnce, retain, None)
        });
        let login = self.login.clone().map(|Login { user, password }| v5::Login { username: user, password });
        Packet::Connect(connect, will, login)
    }
}

/// User and password at a broker.
#[derive(Clone, PartialEq, Eq)]
pub struct Login {
    /// The user: the name of the device.
    pub user: String,
    /// The password. It is never written to a log.
    pub password: String,
}

impl fmt::Debug for Login {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Login").field("user", &self.user).finish_non_exhaustive()
    }
}
