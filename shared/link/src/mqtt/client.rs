//! An MQTT client on its own thread: what the caller's thread has of it.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::sync::mpsc::{Receiver, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

use super::settings::{ClientSettings, EVENTS_MAX};
use super::shared::{ClientEvent, Shared};
use super::worker::Worker;
use crate::transport::PublishError;

/// An MQTT client. When it is dropped, it sends what waits, for at most 2 seconds, and then breaks the connection
/// without a farewell, so that the broker publishes the last will.
#[derive(Debug)]
pub(super) struct Client {
    shared: Arc<Shared>,
    events: Receiver<ClientEvent>,
    thread: Option<JoinHandle<()>>,
}

impl Client {
    /// Starts connecting.
    pub(super) fn start(settings: ClientSettings) -> Self {
        let shared = Arc::new(Shared::new());
        let (sender, events) = sync_channel(EVENTS_MAX);
        let worker = Worker::new(settings, Arc::clone(&shared), sender);
        let thread = std::thread::spawn(move || worker.run());
        Self { shared, events, thread: Some(thread) }
    }

    /// Queues a message for sending.
    pub(super) fn publish(&self, topic: &str, payload: &[u8], retain: bool) -> Result<(), PublishError> {
        self.shared.push(topic, payload, retain)
    }

    /// Returns the next event, or `None` if there is none within `timeout`.
    pub(super) fn poll(&self, timeout: Duration) -> Option<ClientEvent> {
        self.events.recv_timeout(timeout).ok()
    }

    /// Number of messages that wait or are not acknowledged.
    pub(super) fn pending(&self) -> usize {
        self.shared.pending.load(Ordering::Relaxed)
    }

    /// Number of messages that were acknowledged.
    pub(super) fn acknowledged(&self) -> usize {
        self.shared.acknowledged.load(Ordering::Relaxed)
    }
}

impl Drop for Client {
    fn drop(&mut self) {
        self.shared.is_stopping.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A panic of the thread has already been printed.
            let _ = thread.join();
        }
    }
}
