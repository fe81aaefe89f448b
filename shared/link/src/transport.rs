//! The interface between a participant and the network: it publishes messages, and receives the messages that
//! it subscribes to.

use std::time::Duration;

use cosurf_wire::{Message, Reply, SiteId, Topic, TopicString};

/// Carries messages under topics. It guarantees little: messages may be lost, duplicated, delayed and
/// reordered. The protocol tolerates this.
pub trait Transport {
    /// Queues a message for sending.
    fn publish(&mut self, message: &Outgoing) -> Result<(), PublishError>;

    /// Returns the next event, or `None` if there is none within `timeout`.
    fn poll(&mut self, timeout: Duration) -> Option<TransportEvent>;
}

/// Whether a message counts that the broker has retained. Only strangers retain chunks and replies. Without this check, the
/// broker would repeat theirs at each connection, long after the strangers have gone.
pub(crate) fn counts_retained(topic: &str) -> bool {
    Topic::parse(topic).map_or(true, |(_, topic)| topic.is_retained())
}

/// An event of a transport.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum TransportEvent {
    /// A message has arrived.
    Incoming {
        /// The message's topic.
        topic: String,
        /// The message's bytes.
        payload: Vec<u8>,
    },
    /// The connection is up (again), with all its subscriptions. Messages that were published earlier may be
    /// lost.
    Connected,
    /// The connection is up again, and the broker has kept all that it had acknowledged. So of what was published earlier,
    /// only the chunks under these topics may be lost; the transport sends the other messages again by itself.
    Resumed {
        /// The topics, in the order in which the chunks were published.
        lost: Vec<String>,
    },
    /// The connection was lost or could not be made. The transport keeps trying to connect.
    Disconnected {
        /// Number of failures since the last connection that lasted, from 1. The loss of the connection counts too.
        attempt: u32,
        /// One line with the address and the error.
        reason: String,
    },
    /// The broker does not take a message. Told once for each kind of message, until the connection is lost.
    Denied {
        /// One line with the address and the reason.
        reason: String,
    },
}

/// Why a message was not queued.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PublishError {
    /// The queue is full (backpressure): the caller must poll, and then retry.
    #[error("too many messages are queued")]
    Busy,
    /// The message is too large for the link.
    #[error("message of {bytes} bytes, but the link accepts at most {max_bytes}")]
    TooLarge {
        /// Size of the message on the link, in bytes.
        bytes: usize,
        /// Largest size that the link accepts, in bytes.
        max_bytes: usize,
    },
}

/// A message to publish.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Outgoing {
    /// The message's topic.
    pub topic: TopicString,
    /// The message's bytes. An empty payload with `retain` deletes the retained message of the topic.
    pub payload: Vec<u8>,
    /// Whether the broker keeps the message for later subscribers.
    pub retain: bool,
}

/// Whether messages under a topic are chunks of models.
pub(crate) fn is_chunk(topic: &str) -> bool {
    use Topic::{GlobalChunk, LocalChunk, TileChunk};
    matches!(Topic::parse(topic), Ok((_, LocalChunk { .. } | GlobalChunk { .. } | TileChunk { .. })))
}

/// Whether messages under a topic are requests for chunks.
pub(crate) fn is_want(topic: &str) -> bool {
    use Topic::{GlobalReply, LocalReply};
    let reply = match Topic::parse(topic) {
        Ok((_, LocalReply { reply, .. } | GlobalReply { reply, .. })) => reply,
        _ => return false,
    };
    reply == Reply::Want
}

/// Whether the protocol itself makes up for messages under a topic that are lost: chunks, and requests for chunks.
pub(crate) fn is_made_up_for(topic: &str) -> bool {
    is_chunk(topic) || is_want(topic)
}

/// Whether a later message under the same topic makes this one useless: it offers the same model.
pub(crate) fn is_offer(topic: &str) -> bool {
    topic.ends_with("/m")
}

impl Outgoing {
    /// Bytes of topic and payload.
    pub(crate) fn bytes(&self) -> usize {
        self.topic.len() + self.payload.len()
    }

    /// Whether the message is a chunk of a model. All others are control messages, which go before chunks.
    pub fn is_chunk(&self) -> bool {
        is_chunk(&self.topic)
    }

    /// Encodes a message.
    pub(crate) fn new(site: &SiteId, topic: Topic, message: &Message<'_>, retain: bool) -> Self {
        let mut payload = vec![0; message.bytes_max()];
        // Cannot fail: a test of the wire crate checks the largest messages.
        let used = message.encode(&mut payload).expect("a message fits its bytes_max").len();
        payload.truncate(used);
        Self { topic: topic.to_text(site), payload, retain }
    }

    /// A message that deletes the retained message of a topic.
    pub(crate) fn clear(site: &SiteId, topic: Topic) -> Self {
        Self { topic: topic.to_text(site), payload: Vec::new(), retain: true }
    }
}
