//! MQTT 5 by rumqttc, on a thread of its own, so that the connection lives while its owner computes.
//!
//! What rumqttc 0.25 needs to be lived with:
//! - QoS 1, a stable client id, `clean_start = false` and a session expiry: with clean sessions, what
//!   was not acknowledged when a connection broke is dropped without a word.
//! - Explicit packet sizes, and a size check before publishing: a QoS 1 message that the broker finds too
//!   large is repeated, and the connection lost, for ever.
//! - A watch: after certain collisions of packet ids the client never publishes again
//!   (bytebeamio/rumqtt#1014); one without acknowledgements is thrown away and a new one started.
//! - Version 5, since only there brokers say how large a packet and how many they take, and forget the
//!   sessions of those who do not come back.
//!
//! It keeps nothing on a disk; what is lost with it is asked for again by the conversation above. Clocks
//! are read here for timeouts only: nothing that is computed depends on them.

pub mod tap;
#[cfg(test)]
mod tests;
mod tls;
mod worker;

use std::fmt;
use std::str::FromStr;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::sync::mpsc::{Receiver, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

use rumqttc::v5::mqttbytes::QoS;

use crate::identity::Identity;
use crate::transport::{Outgoing, PublishError, Transport, TransportEvent};
pub use tls::{Tls, TlsError};
use worker::{Shared, Worker};

/// Events that wait for the owner: 4 MiB of chunks. What comes beyond that, while the owner computes, is
/// dropped, and asked for again later.
const EVENTS_MAX: usize = 64;
/// The ports of MQTT without and with TLS (IANA).
const DEFAULT_PORT: u16 = 1883;
const DEFAULT_PORT_TLS: u16 = 8883;
/// Bytes of a publish packet beside topic and payload, generously.
const PACKET_OVERHEAD_BYTES: usize = 16;

/// Where a broker listens: `mqtt://host:port`, `host:port` or `host` (port 1883); or with TLS
/// `mqtts://host:port` (port 8883).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BrokerAddress {
    /// Name or number of the host.
    pub host: String,
    /// TCP port.
    pub port: u16,
    /// Whether it wants TLS.
    pub is_tls: bool,
}

impl fmt::Display for BrokerAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", self.socket_host(), self.port)
    }
}

impl BrokerAddress {
    /// The host as it stands before a port: IPv6 numbers in brackets.
    fn socket_host(&self) -> String {
        if self.host.contains(':') { format!("[{}]", self.host) } else { self.host.clone() }
    }
}

/// What is wrong with the text of an address.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "broker address {text:?}: write mqtt://host:port, or mqtts://host:port for TLS (no password, no path)"
)]
pub struct BadAddress {
    text: String,
}

impl FromStr for BrokerAddress {
    type Err = BadAddress;

    fn from_str(text: &str) -> Result<Self, BadAddress> {
        let bad = || BadAddress { text: text.to_owned() };
        let secured = text.strip_prefix("mqtts://");
        let rest = secured.or_else(|| text.strip_prefix("mqtt://")).unwrap_or(text);
        let rest = rest.strip_suffix('/').unwrap_or(rest);
        let (host, port) = match rest.strip_prefix('[').and_then(|rest| rest.split_once(']')) {
            Some((host, port)) => (host, port.strip_prefix(':')),
            None => rest.split_once(':').map_or((rest, None), |(host, port)| (host, Some(port))),
        };
        let is_bracketed = rest.starts_with('[');
        let allowed = |c: char| c.is_ascii_alphanumeric() || "-._".contains(c) || (is_bracketed && c == ':');
        if host.is_empty() || !host.chars().all(allowed) {
            return Err(bad());
        }
        let is_tls = secured.is_some();
        let usual = if is_tls { DEFAULT_PORT_TLS } else { DEFAULT_PORT };
        let port = port.map_or(Ok(usual), |port| port.parse().map_err(|_| bad()))?;
        Ok(Self { host: host.to_owned(), port, is_tls })
    }
}

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

/// A client of an MQTT broker. When it is dropped, what was published is carried out (for at most
/// 2 seconds); then the connection is cut, and the broker publishes the last will.
#[derive(Debug)]
pub struct MqttTransport {
    shared: Arc<Shared>,
    events: Receiver<TransportEvent>,
    thread: Option<JoinHandle<()>>,
}

impl MqttTransport {
    /// Starts to connect; success and failure come as events.
    pub fn start(config: MqttConfig) -> Self {
        let shared = Arc::new(Shared::default());
        let (sender, events) = sync_channel(EVENTS_MAX);
        let worker = Worker::new(config, Arc::clone(&shared), sender);
        let thread = std::thread::spawn(move || worker.run());
        Self { shared, events, thread: Some(thread) }
    }
}

impl Transport for MqttTransport {
    fn publish(&mut self, message: &Outgoing) -> Result<(), PublishError> {
        let bytes = message.topic.len() + message.payload.len() + PACKET_OVERHEAD_BYTES;
        let max_bytes = self.shared.packet_bytes_max.load(Ordering::Relaxed);
        if bytes > max_bytes {
            return Err(PublishError::TooLarge { bytes, max_bytes });
        }
        let Some(client) = self.shared.client() else { return Err(PublishError::Busy) };
        let payload = message.payload.clone();
        // Counted first, since the acknowledgement may come before this thread goes on.
        self.shared.unacknowledged.fetch_add(1, Ordering::Relaxed);
        let taken = client.try_publish(message.topic.as_str(), QoS::AtLeastOnce, message.retain, payload);
        if taken.is_err() {
            self.shared.acknowledged();
        }
        taken.map_err(|_| PublishError::Busy)
    }

    fn poll(&mut self, timeout: Duration) -> Option<TransportEvent> {
        self.events.recv_timeout(timeout).ok()
    }
}

impl Drop for MqttTransport {
    fn drop(&mut self) {
        self.shared.is_stopping.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A panic there has been printed; there is nothing to add.
            let _ = thread.join();
        }
    }
}
