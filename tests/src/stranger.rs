//! A stranger on the broker of a simulated fleet: it hears everything, and says what it likes.

use std::time::Duration;

use cosurf_link::{MemoryNetwork, MemoryTransport, Outgoing, Transport, TransportEvent};
use cosurf_wire::{MAX_MESSAGE_BYTES, Message, SiteId, Topic};

/// A client of the broker that is no participant.
pub struct Stranger {
    transport: MemoryTransport,
    /// All messages that the stranger has heard, by topic.
    pub heard: Vec<(String, Vec<u8>)>,
}

impl Stranger {
    /// Connects to the broker.
    pub fn new(network: &MemoryNetwork) -> Self {
        Self { transport: network.join_all(), heard: Vec::new() }
    }

    /// Publishes a message without a seal.
    pub fn say(&mut self, topic: Topic, message: &Message<'_>) {
        let payload = message.encode(&mut vec![0; MAX_MESSAGE_BYTES]).unwrap().to_vec();
        self.say_bytes(&topic.to_text(&SiteId::new("site").unwrap()), payload);
    }

    /// Publishes any bytes. They are lost if too many messages are on their way.
    pub fn say_bytes(&mut self, topic: &str, payload: Vec<u8>) {
        let topic = topic.parse().unwrap();
        let _ = self.transport.publish(&Outgoing { topic, payload, retain: false });
    }

    /// Deletes what the broker retains under a topic.
    pub fn delete(&mut self, topic: Topic) {
        let topic = topic.to_text(&SiteId::new("site").unwrap());
        let _ = self.transport.publish(&Outgoing { topic, payload: Vec::new(), retain: true });
    }

    /// Takes what has arrived.
    pub fn listen(&mut self) {
        while let Some(event) = self.transport.poll(Duration::ZERO) {
            if let TransportEvent::Incoming { topic, payload } = event {
                self.heard.push((topic, payload));
            }
        }
    }

    /// The messages heard so far whose topics end with `end`.
    pub fn heard_on(&self, end: &str) -> Vec<(String, Vec<u8>)> {
        self.heard.iter().filter(|(topic, _)| topic.ends_with(end)).cloned().collect()
    }
}
