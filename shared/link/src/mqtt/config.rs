//! The settings of a client, and limits that its two threads share.

use super::address::BrokerAddress;
use super::tls::Tls;
use crate::identity::Identity;

/// Events that wait for the owner: 4 MiB of chunks. What comes beyond that, while the owner computes, is
/// dropped, and asked for again later.
pub(super) const EVENTS_MAX: usize = 64;
/// Bytes of a publish packet beside topic and payload, generously.
pub(super) const PACKET_OVERHEAD_BYTES: usize = 16;

/// How to connect.
#[derive(Clone, Debug)]
pub struct MqttConfig {
    /// Where to.
    pub broker: BrokerAddress,
    /// As whom: gives client id, subscriptions and last will.
    pub identity: Identity,
    /// Certificates, for a broker that wants TLS.
    pub tls: Option<Tls>,
}
