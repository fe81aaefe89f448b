//! A connection that counts what its participant sends and receives.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use cosurf_link::{MemoryTransport, ModelKey, Outgoing, PublishError, Transport, TransportEvent};
use cosurf_wire::{DeviceId, Message, Topic};

use crate::memory::allocated_bytes;

/// What a participant has sent and received in its session.
#[derive(Debug, Default)]
pub(crate) struct Traffic {
    pub(crate) received: u64,
    /// Messages sent, without chunks.
    pub(crate) told: u64,
    /// Chunks sent of each model.
    pub(crate) chunks: BTreeMap<ModelKey, u64>,
    /// The devices whose offers were answered.
    pub(crate) answered: BTreeSet<DeviceId>,
}

/// A connection that counts.
pub(crate) struct Metered {
    pub(crate) inner: MemoryTransport,
    pub(crate) traffic: Traffic,
    /// How often each message is sent: more than once only by a participant that is broken on purpose.
    pub(crate) copies: usize,
    /// Memory that was allocated here and not by the node, bytes. What is handed to the node counts as freed.
    foreign_bytes: isize,
}

impl Metered {
    pub(crate) fn new(inner: MemoryTransport) -> Self {
        Self { inner, traffic: Traffic::default(), copies: 1, foreign_bytes: 0 }
    }

    /// Memory that was allocated here since the last call.
    pub(crate) fn take_foreign_bytes(&mut self) -> isize {
        std::mem::take(&mut self.foreign_bytes)
    }
}

impl Traffic {
    fn count(&mut self, message: &Outgoing) {
        let Ok((_, topic)) = Topic::parse(&message.topic) else { return };
        match (topic, Message::decode(&message.payload)) {
            (_, Ok(Message::Chunk(chunk))) => {
                let key = ModelKey { device: chunk.device, model: chunk.model };
                *self.chunks.entry(key).or_default() += 1;
                return;
            }
            (Topic::LocalReply { device, .. }, Ok(_)) => _ = self.answered.insert(device),
            _ => {}
        }
        self.told += 1;
    }
}

impl Transport for Metered {
    fn publish(&mut self, message: &Outgoing) -> Result<(), PublishError> {
        let before = allocated_bytes();
        let published = self.inner.publish(message);
        if published.is_ok() {
            (0..self.copies).for_each(|_| self.traffic.count(message));
            (1..self.copies).for_each(|_| _ = self.inner.publish(message));
        }
        self.foreign_bytes += allocated_bytes() - before;
        published
    }

    fn poll(&mut self, timeout: Duration) -> Option<TransportEvent> {
        let before = allocated_bytes();
        let event = self.inner.poll(timeout);
        self.foreign_bytes += allocated_bytes() - before;
        match &event {
            Some(TransportEvent::Incoming { topic, payload }) => {
                self.traffic.received += 1;
                self.foreign_bytes -= (topic.capacity() + payload.capacity()) as isize;
            }
            Some(TransportEvent::Disconnected { reason, .. } | TransportEvent::Denied { reason }) => {
                self.foreign_bytes -= reason.capacity() as isize
            }
            Some(TransportEvent::Resumed { lost }) => {
                self.foreign_bytes -= lost.iter().map(String::capacity).sum::<usize>() as isize;
            }
            Some(TransportEvent::Connected) | None => {}
        }
        event
    }
}
