//! An MQTT 5 client (rumqttc) on its own thread, so that the connection stays alive while the caller
//! computes.
//!
//! rumqttc 0.25 requires these settings:
//! - QoS 1, a stable client id, `clean_start = false` and a session expiry. With clean sessions, the client
//!   silently drops unacknowledged messages when a connection breaks.
//! - Explicit packet sizes, and a size check before publishing. If a QoS 1 message were too large for the
//!   broker, the client would repeat it without end, and lose the connection each time.
//! - A watchdog. After certain collisions of packet ids the client never publishes again
//!   (bytebeamio/rumqtt#1014). A client that gets no acknowledgements is therefore replaced by a new one.
//! - Version 5 of MQTT. Brokers announce their maximum packet size and number of packets in flight only in
//!   this version. It also lets them drop expired sessions.
//!
//! The client keeps nothing on disk, since the protocol requests lost messages again. The clock is read only
//! for timeouts, so no result depends on it.

mod address;
mod config;
mod refusal;
#[cfg(test)]
mod tests;
mod tls;
pub mod traffic;
mod worker;

pub use address::{BadAddress, BrokerAddress};
pub use config::{Login, MqttConfig};
pub use tls::{Tls, TlsError, TlsFiles};

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::sync::mpsc::{Receiver, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

use rumqttc::v5::mqttbytes::QoS;

use crate::transport::{Outgoing, PublishError, Transport, TransportEvent};
use config::{EVENTS_MAX, PACKET_OVERHEAD_BYTES};
use worker::{Shared, Worker};

/// A client of an MQTT broker. Dropping it first sends the queued messages, for at most 2 seconds, and then
/// closes the connection. The broker then publishes the last will, which announces the end of the session.
#[derive(Debug)]
pub struct MqttTransport {
    shared: Arc<Shared>,
    events: Receiver<TransportEvent>,
    thread: Option<JoinHandle<()>>,
}

impl MqttTransport {
    /// Starts connecting. [`Transport::poll`] reports success and failure as events.
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
        // Counted before publishing, because the worker may see the acknowledgement as soon as the message is
        // queued.
        self.shared.unacknowledged.fetch_add(1, Ordering::Relaxed);
        let queued = client.try_publish(message.topic.as_str(), QoS::AtLeastOnce, message.retain, payload);
        if queued.is_err() {
            self.shared.count_acknowledgement();
        }
        queued.map_err(|_| PublishError::Busy)
    }

    fn poll(&mut self, timeout: Duration) -> Option<TransportEvent> {
        self.events.recv_timeout(timeout).ok()
    }
}

impl Drop for MqttTransport {
    fn drop(&mut self) {
        self.shared.is_stopping.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A panic of the thread has already been printed.
            let _ = thread.join();
        }
    }
}
