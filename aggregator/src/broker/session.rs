//! The broker's state of one client: subscriptions, queued messages, unacknowledged messages.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar};
use std::time::Instant;

use rumqttc::v5::mqttbytes::v5::{DisconnectReasonCode, Filter, LastWill, Packet, Publish};
use rumqttc::v5::mqttbytes::{QoS, matches};

/// Limit on messages queued for one client; retained messages of a new subscription may exceed it.
const QUEUE_MAX: usize = 512;
/// Limit on the bytes of the messages queued for one client: 256 chunks of 64 KiB. Retained messages of a new
/// subscription may exceed it.
const QUEUE_BYTES_MAX: usize = 16 << 20;
/// Limit on answers queued for one client. While it is reached, no packet of the client is handled.
const ANSWERS_MAX: usize = 1024;
/// Limit on the subscriptions of one client.
pub(super) const FILTERS_MAX: usize = 32;

/// The state of one client, connected or not.
#[derive(Debug, Default)]
pub(super) struct Session {
    pub(super) filters: Vec<Filter>,
    queue: VecDeque<Publish>,
    queue_bytes: usize,
    /// QoS 1 messages that were sent and not yet acknowledged, oldest first.
    in_flight: VecDeque<Publish>,
    last_pkid: u16,
    pub(super) link: Option<Link>,
    /// True after the queue was full for too long. Publishers then do not wait for this client until it
    /// accepts a message again.
    pub(super) is_stalled: bool,
    /// Time at which the session is dropped; `None` while the client is connected.
    pub(super) expires: Option<Instant>,
}

/// The connection of a session.
#[derive(Debug)]
pub(super) struct Link {
    /// Number of the connection; a newer connection may take the session over.
    pub(super) id: u64,
    /// Limit on QoS 1 messages that were sent and not yet acknowledged.
    pub(super) receive_max: usize,
    /// The largest packet that the client accepts.
    pub(super) packet_bytes_max: usize,
    /// The last will, which is published unless the client ends the connection gracefully.
    pub(super) will: Option<LastWill>,
    /// How long the session outlives the connection, seconds.
    pub(super) expiry_s: u32,
    /// Wakes the writer thread.
    pub(super) work: Arc<Condvar>,
    /// The reason to send in DISCONNECT; `None` unless the connection must end.
    pub(super) closing: Option<DisconnectReasonCode>,
    answers: VecDeque<Packet>,
}

impl Link {
    pub(super) fn new(id: u64, work: Arc<Condvar>) -> Self {
        Self {
            id,
            receive_max: usize::from(u16::MAX),
            packet_bytes_max: usize::MAX,
            will: None,
            expiry_s: 0,
            work,
            closing: None,
            answers: VecDeque::new(),
        }
    }
}

impl Session {
    /// This client's subscription to `topic` with the highest QoS, if there is one. If the client itself
    /// publishes the message (`is_own`), its subscriptions with the option "no local" do not count.
    pub(super) fn wants(&self, topic: &str, is_own: bool) -> Option<&Filter> {
        let wanted = self.filters.iter().filter(|filter| !(is_own && filter.nolocal));
        wanted.filter(|filter| matches(topic, &filter.path)).max_by_key(|filter| filter.qos as u8)
    }

    /// Whether there is no room for another message of `bytes`.
    pub(super) fn is_full(&self, bytes: usize) -> bool {
        self.queue.len() >= QUEUE_MAX || self.queue_bytes + bytes > QUEUE_BYTES_MAX
    }

    /// Whether too many answers are queued. The client's next packet must then wait until the client has read some.
    pub(super) fn is_flooded(&self) -> bool {
        self.link.as_ref().is_some_and(|link| link.answers.len() >= ANSWERS_MAX)
    }

    /// Queues a message, even in a full queue. Drops a packet larger than the client accepts, as MQTT demands.
    pub(super) fn enqueue(&mut self, publish: Publish) {
        let Some(link) = &self.link else {
            // Only QoS 1 messages wait for a disconnected client.
            if publish.qos == QoS::AtLeastOnce {
                self.push(publish);
            }
            return;
        };
        if publish.size() + 2 <= link.packet_bytes_max {
            link.work.notify_one();
            self.push(publish);
        }
    }

    /// Queues an answer to the client's own packet.
    pub(super) fn answer(&mut self, packet: Packet) {
        if let Some(link) = &mut self.link {
            link.answers.push_back(packet);
            link.work.notify_one();
        }
    }

    /// Removes and returns the packets to write next: all answers, then messages until they have `bytes_max`
    /// bytes or the client accepts no more.
    pub(super) fn take(&mut self, bytes_max: usize) -> Vec<Packet> {
        let Some(link) = &mut self.link else { return Vec::new() };
        let mut packets: Vec<Packet> = link.answers.drain(..).collect();
        let receive_max = link.receive_max;
        let mut bytes = 0;
        while bytes < bytes_max {
            let Some(next) = self.queue.front() else { break };
            if next.qos == QoS::AtLeastOnce && self.in_flight.len() >= receive_max {
                break;
            }
            let Some(publish) = self.pop() else { break };
            bytes += publish.size();
            packets.push(Packet::Publish(publish));
        }
        packets
    }

    /// Removes a message that the client has acknowledged.
    pub(super) fn acknowledge(&mut self, pkid: u16) {
        if let Some(place) = self.in_flight.iter().position(|publish| publish.pkid == pkid) {
            self.in_flight.remove(place);
            self.is_stalled = false;
            if let Some(link) = &self.link {
                link.work.notify_one();
            }
        }
    }

    /// Ends the connection: QoS 0 messages are dropped, and unacknowledged messages go back to the front of
    /// the queue.
    pub(super) fn unlink(&mut self) {
        self.link = None;
        self.is_stalled = false;
        self.queue.retain(|publish| publish.qos == QoS::AtLeastOnce);
        while let Some(mut publish) = self.in_flight.pop_back() {
            publish.dup = true;
            self.queue.push_front(publish);
        }
        self.queue_bytes = self.queue.iter().map(bytes_of).sum();
    }

    fn push(&mut self, publish: Publish) {
        self.queue_bytes += bytes_of(&publish);
        self.queue.push_back(publish);
    }

    fn pop(&mut self) -> Option<Publish> {
        let mut publish = self.queue.pop_front()?;
        self.queue_bytes -= bytes_of(&publish);
        if publish.qos == QoS::AtLeastOnce {
            // A message sent on an earlier connection keeps its packet id.
            if publish.pkid == 0 {
                publish.pkid = self.next_pkid();
            }
            self.in_flight.push_back(publish.clone());
        } else {
            self.is_stalled = false;
        }
        Some(publish)
    }

    /// A packet id that no unacknowledged message has. The search ends, because there are more ids than such
    /// messages.
    fn next_pkid(&mut self) -> u16 {
        loop {
            self.last_pkid = self.last_pkid.checked_add(1).unwrap_or(1);
            if self.in_flight.iter().all(|publish| publish.pkid != self.last_pkid) {
                return self.last_pkid;
            }
        }
    }
}

/// Bytes of topic and payload: what a message adds towards the limits on queues and on retained messages.
pub(super) fn bytes_of(publish: &Publish) -> usize {
    publish.topic.len() + publish.payload.len()
}
