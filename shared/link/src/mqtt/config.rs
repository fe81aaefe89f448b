//! The settings of a client, and limits that its two threads share.

use super::address::BrokerAddress;
use super::tls::Tls;
use crate::identity::Identity;

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
    /// The participant. It determines the client id, the subscriptions and the last will.
    pub identity: Identity,
    /// Certificates, if the broker requires TLS.
    pub tls: Option<Tls>,
}
