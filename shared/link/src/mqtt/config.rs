//! The settings of a client, and the limits that its two threads share.

use super::address::BrokerAddress;
use super::tls::Tls;
use crate::identity::Identity;

/// Maximum number of queued events: 4 MiB of chunks. Further messages are dropped while the caller computes,
/// and requested again later.
pub(super) const EVENTS_MAX: usize = 64;
/// Upper bound on the bytes of a publish packet besides topic and payload.
pub(super) const PACKET_OVERHEAD_BYTES: usize = 16;

/// The settings of a client.
#[derive(Clone, Debug)]
pub struct MqttConfig {
    /// The broker's address.
    pub broker: BrokerAddress,
    /// The participant. It determines client id, subscriptions and last will.
    pub identity: Identity,
    /// Certificates, if the broker requires TLS.
    pub tls: Option<Tls>,
}
