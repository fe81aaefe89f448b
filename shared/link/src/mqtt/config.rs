//! The settings of a participant's client, and limits that its two threads share.

use std::fmt;

use cosurf_wire::{MAX_MESSAGE_BYTES, MAX_TOPIC_BYTES};
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{Filter, RetainForwardRule};

use super::address::BrokerAddress;
use super::client::ClientSettings;
use super::tls::Tls;
use crate::identity::Identity;
use crate::transport::Outgoing;

/// Maximum number of events that wait for the caller: 64 chunks of 64 KiB are 4 MiB. If the caller computes
/// for too long, further messages are dropped, and the protocol requests them again.
pub(super) const EVENTS_MAX: usize = 64;
/// Upper bound on the bytes of a publish packet besides topic and payload.
pub(super) const PACKET_OVERHEAD_BYTES: usize = 16;
/// Largest packet that a client accepts, in bytes.
pub(super) const PACKET_BYTES_MAX: usize = MAX_MESSAGE_BYTES + MAX_TOPIC_BYTES + PACKET_OVERHEAD_BYTES;
/// The broker keeps the session of a disconnected participant for this long: enough for a battery change.
const SESSION_EXPIRY_S: u32 = 3600;

/// The settings of a client.
#[derive(Clone, Debug)]
pub struct MqttConfig {
    /// The broker's address.
    pub broker: BrokerAddress,
    /// The participant. It determines the client id and the subscriptions.
    pub identity: Identity,
    /// What the broker publishes when the connection breaks: [`crate::last_will`].
    pub will: Option<Outgoing>,
    /// Certificates, if the broker requires TLS.
    pub tls: Option<Tls>,
    /// User and password, if the broker asks for them.
    pub login: Option<Login>,
}

impl MqttConfig {
    /// What the client needs of it. It subscribes to everything that its role must read.
    pub(super) fn into_client(self) -> ClientSettings {
        let Self { broker, identity, will, tls, login } = self;
        let filters = identity.filters();
        let filters = filters.iter().map(|path| Filter {
            path: path.as_str().to_owned(),
            qos: QoS::AtLeastOnce,
            nolocal: true,
            preserve_retain: false,
            retain_forward_rule: RetainForwardRule::OnEverySubscribe,
        });
        ClientSettings {
            broker,
            tls,
            login,
            client_id: identity.client_id(),
            session_expiry_s: SESSION_EXPIRY_S,
            will,
            filters: filters.collect(),
        }
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
