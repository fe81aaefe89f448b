//! An MQTT 5 client on its own thread, so that the connection stays alive while the caller computes.
//!
//! Packets are read and written by the codec of rumqttc. Its event loop is not used, for three reasons:
//! - One queue carries all messages, so that pings and replies wait behind a megabyte of chunks, and it sends every
//!   unacknowledged chunk again after each lost connection. On a line of 20 kB/s that breaks every 6 s, an upload never
//!   ended. Here control goes before bulk, and what is in flight follows the line ([`session`]).
//! - After certain collisions of packet ids it never publishes again (bytebeamio/rumqtt#1014).
//! - Its TLS links rustls-webpki 0.102.8 (RUSTSEC-2026-0049, -0098, -0099, -0104) and the unmaintained rustls-pemfile.
//!
//! What the client asks of a broker:
//! - QoS 1, a stable client id and a session that outlives the connection. With clean sessions a broker would drop what
//!   it holds for a client that is away for a moment.
//! - Explicit packet sizes, and a size check before publishing. If a QoS 1 message were too large for the broker, the
//!   client would repeat it without end, and lose the connection each time.
//! - Version 5 of MQTT. Brokers announce their maximum packet size and number of packets in flight only in this
//!   version. It also lets them drop expired sessions.
//!
//! The client keeps nothing on disk, since the protocol requests lost messages again. The clock is read only for
//! timeouts, so no result depends on it.

mod address;
mod client;
mod config;
mod connection;
mod fault;
pub mod packet;
mod presence;
mod probe;
mod session;
mod settings;
mod shared;
mod stream;
#[cfg(test)]
mod tests;
mod tls;
pub mod traffic;
mod worker;

pub use address::{BadAddress, BrokerAddress};
pub use config::MqttConfig;
pub use presence::is_present;
pub use probe::probe;
pub use settings::Login;
pub use tls::{Tls, TlsError, TlsFiles};

use std::fmt;
use std::time::Duration;

use cosurf_wire::{DeviceId, Topic};

use crate::transport::{Outgoing, PublishError, Transport, TransportEvent, counts_retained};
use client::Client;
use shared::ClientEvent;

/// A status of a device as it arrived.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct HeardStatus {
    /// The device under whose topic it arrived.
    pub device: DeviceId,
    /// Its bytes. Anybody who may write to the topic may have sent them.
    pub payload: Vec<u8>,
    /// True if the broker had kept it from earlier.
    pub is_kept: bool,
}

/// A participant's connection to an MQTT broker. Dropping it first sends the queued messages, for at most 2 seconds, and
/// then breaks the connection. The broker then publishes the last will, which announces the end of the session.
pub struct MqttTransport {
    client: Client,
    /// What gets the statuses of devices. They are no part of the protocol.
    on_status: Option<Box<dyn Fn(HeardStatus) + Send>>,
}

impl MqttTransport {
    /// Starts connecting. [`Transport::poll`] reports success and failure as events.
    pub fn start(config: MqttConfig) -> Self {
        Self { client: Client::start(config.into_client()), on_status: None }
    }

    /// The same, and `on_status` gets how far the devices of the site are. It is called by [`Transport::poll`]. A connection
    /// of its own for statuses would not do: brokers that know clients by their names accept only one of each name.
    pub fn start_hearing(config: MqttConfig, on_status: impl Fn(HeardStatus) + Send + 'static) -> Self {
        Self { client: Client::start(config.into_hearing_client()), on_status: Some(Box::new(on_status)) }
    }

    /// Starts connecting as a device that only reports: it reads nothing but which flights are confirmed, so that the models
    /// for other devices do not use its line.
    pub fn start_reporting(config: MqttConfig) -> Self {
        Self { client: Client::start(config.into_reporting_client()), on_status: None }
    }

    /// The same under a client id of its own, for a device that asks before a flight: what the broker keeps for the device
    /// itself stays. A broker that takes the client id from certificates or users drops it all the same.
    pub fn start_asking(config: MqttConfig) -> Self {
        Self { client: Client::start(config.into_asking_client()), on_status: None }
    }

    /// Hands a status on. Returns false if a message is none. After a restart without `on_status`, the broker may still send
    /// statuses to the session that it has kept.
    fn hear_status(&self, topic: &str, payload: &[u8], is_kept: bool) -> bool {
        let Ok((_, Topic::Status { device })) = Topic::parse(topic) else { return false };
        if let Some(on_status) = self.on_status.as_ref().filter(|_| !payload.is_empty()) {
            on_status(HeardStatus { device, payload: payload.to_vec(), is_kept });
        }
        true
    }
}

impl fmt::Debug for MqttTransport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("MqttTransport").field("client", &self.client).finish_non_exhaustive()
    }
}

impl Transport for MqttTransport {
    fn publish(&mut self, message: &Outgoing) -> Result<(), PublishError> {
        self.client.publish(&message.topic, &message.payload, message.retain)
    }

    fn poll(&mut self, timeout: Duration) -> Option<TransportEvent> {
        self.client.poll(timeout).and_then(|event| match event {
            ClientEvent::Connected => Some(TransportEvent::Connected),
            ClientEvent::Resumed { lost } => Some(TransportEvent::Resumed { lost }),
            ClientEvent::Disconnected { attempt, reason } => {
                Some(TransportEvent::Disconnected { attempt, reason })
            }
            ClientEvent::Denied { reason } => Some(TransportEvent::Denied { reason }),
            ClientEvent::Message { topic, payload, retain, .. }
                if self.hear_status(&topic, &payload, retain) =>
            {
                None
            }
            ClientEvent::Message { topic, retain: true, .. } if !counts_retained(&topic) => None,
            ClientEvent::Message { topic, payload, .. } => Some(TransportEvent::Incoming { topic, payload }),
        })
    }
}
