//! What a participant needs of a network: publish, and hear what it subscribed to.

use std::time::Duration;

use cosurf_wire::{Message, SiteId, Topic, TopicString};

/// Carries bytes under topics, at least once while it is connected, and nothing more: messages may be
/// lost with a connection, doubled and reordered. The conversation above copes.
pub trait Transport {
    /// Hands over one message.
    fn publish(&mut self, message: &Outgoing) -> Result<(), PublishError>;

    /// The next thing that happened, waiting for it at most `timeout`.
    fn poll(&mut self, timeout: Duration) -> Option<TransportEvent>;
}

/// What happens on a transport.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum TransportEvent {
    /// A message.
    Incoming {
        /// Under which topic.
        topic: String,
        /// Its bytes.
        payload: Vec<u8>,
    },
    /// The connection stands (again) with all its subscriptions. What was published before may be lost.
    Connected,
    /// The connection is lost or could not be made; it is tried again without being asked.
    Disconnected {
        /// Failed attempts since it last stood, from 1.
        attempt: u32,
        /// One line: where to, why not, which attempt.
        reason: String,
    },
}

/// Why a message was not taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PublishError {
    /// As many messages are under way as there is room for: poll, then try again.
    #[error("too many messages under way")]
    Busy,
    /// It never can be sent.
    #[error("message of {bytes} bytes, the link takes {max_bytes}")]
    TooLarge {
        /// Bytes of the whole packet.
        bytes: usize,
        /// What the link takes.
        max_bytes: usize,
    },
}

/// A message to publish.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Outgoing {
    /// Under which topic.
    pub topic: TopicString,
    /// Its bytes; empty and retained takes back what was retained.
    pub payload: Vec<u8>,
    /// Whether the broker keeps it for those who subscribe later.
    pub retain: bool,
}

impl Outgoing {
    /// A message, encoded.
    pub(crate) fn new(site: &SiteId, topic: Topic, message: &Message<'_>, retain: bool) -> Self {
        let mut payload = vec![0; message.bytes_max()];
        // A test of the wire holds every message to these sizes.
        let used = message.encode(&mut payload).expect("every message fits its largest size").len();
        payload.truncate(used);
        Self { topic: topic.to_text(site), payload, retain }
    }

    /// Takes back what is retained under a topic.
    pub(crate) fn clear(site: &SiteId, topic: Topic) -> Self {
        Self { topic: topic.to_text(site), payload: Vec::new(), retain: true }
    }
}
