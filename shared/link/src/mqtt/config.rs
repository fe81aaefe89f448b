//! The settings of a client, and limits that its two threads share.

use std::fmt;

use super::address::BrokerAddress;
use super::tls::Tls;
use crate::identity::Identity;
use crate::transport::Outgoing;

/// Maximum number of events that wait for the caller: 64 chunks of 64 KiB are 4 MiB. If the caller computes
/// for too long, further messages are dropped, and the protocol requests them again.
pub(super) const EVENTS_MAX: usize = 64;
/// Upper bound on the bytes of a publish packet besides topic and payload.
pub(super) const PACKET_OVERHEAD_BYTES: usize = 16;

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
