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

mod address;
mod config;
pub mod tap;
#[cfg(test)]
mod tests;
mod tls;
mod worker;

pub use address::{BadAddress, BrokerAddress};
pub use config::MqttConfig;
pub use tls::{Tls, TlsError};

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::sync::mpsc::{Receiver, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

use rumqttc::v5::mqttbytes::QoS;

use crate::transport::{Outgoing, PublishError, Transport, TransportEvent};
use config::{EVENTS_MAX, PACKET_OVERHEAD_BYTES};
use worker::{Shared, Worker};

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
