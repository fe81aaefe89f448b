//! What a participant needs of a network: publish, subscribe, hear.

use std::time::Duration;

/// Carries bytes under topics, at least once while it is connected, and nothing more: messages may be
/// lost with a connection, doubled and reordered. The conversation above copes.
pub trait Transport {
    /// Asks for everything published under `filter` (MQTT wildcards), now and after each reconnection.
    fn subscribe(&mut self, filter: &str);

    /// Hands over one message. `retain` keeps it with the broker for those who subscribe later; an
    /// empty retained payload takes that back.
    fn publish(&mut self, topic: &str, payload: &[u8], retain: bool) -> Result<(), PublishError>;

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
    /// The connection stands (again). What was published before may be lost.
    Connected,
    /// The connection is lost or could not be made; it is tried again without being asked.
    Disconnected {
        /// Failed attempts since it last stood, from 1.
        attempt: u32,
        /// One line: where to, and why not. Like `broker 127.0.0.1:1883: connection refused (attempt 3)`.
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
    #[error("message of {bytes} bytes, the link takes {max_bytes}: use smaller chunks")]
    TooLarge {
        /// Bytes of topic and payload.
        bytes: usize,
        /// What the link takes.
        max_bytes: usize,
    },
}
