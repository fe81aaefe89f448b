//! Retained messages: the last message of each topic that was published to be kept.

use std::collections::BTreeMap;
use std::ops::Bound;
use std::sync::Arc;
use std::time::Instant;

use rumqttc::v5::mqttbytes::QoS;

use super::client::Client;
use super::memory::{Budget, Charge};
use super::message::{Delivery, Message};
use super::topics::{fixed_start, matches};

/// What a retained message takes beside the message itself, bytes.
pub(super) const RETAINED_BYTES: usize = 256;

/// A retained message.
#[derive(Debug)]
struct Kept {
    message: Arc<Message>,
    qos: QoS,
    owner: Client,
    /// Number in the order of publishing.
    number: u64,
    _charge: Charge,
}

/// What one client has published to be kept.
#[derive(Debug, Default)]
struct Owner {
    bytes: usize,
    topics: BTreeMap<u64, Arc<str>>,
}

/// All retained messages.
#[derive(Debug, Default)]
pub(super) struct Retained {
    topics: BTreeMap<Arc<str>, Kept>,
    owners: BTreeMap<Client, Owner>,
    published: u64,
}

/// The retained messages that match a new subscription, as far as the client has not got them.
#[derive(Debug)]
pub(super) struct Page {
    pub(super) filter: String,
    qos: QoS,
    /// The topic after which to go on; `None` at the end.
    after: Option<Bound<String>>,
}

impl Page {
    pub(super) fn new(filter: &str, qos: QoS) -> Self {
        let start = Bound::Included(fixed_start(filter).to_owned());
        Self { filter: filter.to_owned(), qos, after: Some(start) }
    }

    pub(super) fn is_over(&self) -> bool {
        self.after.is_none()
    }

    /// What the page takes in memory, at most.
    pub(super) fn bytes(&self) -> usize {
        size_of::<Self>() + self.filter.len() + super::topics::TEXT_BYTES_MAX
    }
}

impl Retained {
    /// Keeps a message as the last one of its topic.
    pub(super) fn put(&mut self, budget: &Arc<Budget>, owner: &Client, message: Arc<Message>, qos: QoS) {
        self.remove(message.topic());
        self.published += 1;
        let (number, topic) = (self.published, Arc::<str>::from(message.topic()));
        let charge = Charge::new(budget, RETAINED_BYTES + topic.len());
        let of_owner = self.owners.entry(owner.clone()).or_default();
        of_owner.bytes += message.bytes() + charge.bytes();
        of_owner.topics.insert(number, Arc::clone(&topic));
        self.topics.insert(topic, Kept { message, qos, owner: owner.clone(), number, _charge: charge });
    }

    /// Forgets the message of a topic.
    pub(super) fn remove(&mut self, topic: &str) {
        let Some(kept) = self.topics.remove(topic) else { return };
        let Some(owner) = self.owners.get_mut(&kept.owner) else { return };
        owner.bytes -= kept.message.bytes() + RETAINED_BYTES + topic.len();
        owner.topics.remove(&kept.number);
        if owner.topics.is_empty() {
            self.owners.remove(&kept.owner);
        }
    }

    /// Forgets the oldest message that a client has published; returns whether there was one.
    pub(super) fn drop_oldest(&mut self, owner: &Client) -> bool {
        let topics = self.owners.get(owner).and_then(|owner| owner.topics.first_key_value());
        let Some(topic) = topics.map(|(_, topic)| Arc::clone(topic)) else { return false };
        self.remove(&topic);
        true
    }

    /// The clients whose messages are kept, with the bytes that these take.
    pub(super) fn owners(&self) -> impl Iterator<Item = (&Client, usize)> {
        self.owners.iter().map(|(client, owner)| (client, owner.bytes))
    }

    /// Forgets messages that have expired.
    pub(super) fn drop_expired(&mut self, now: Instant) {
        let expired = self.topics.iter().filter(|(_, kept)| kept.message.is_expired(now));
        let topics: Vec<Arc<str>> = expired.map(|(topic, _)| Arc::clone(topic)).collect();
        topics.iter().for_each(|topic| self.remove(topic));
    }

    /// The next messages of a page; looks at no more than `topics_max` topics.
    pub(super) fn turn(&self, page: &mut Page, now: Instant, topics_max: usize) -> Vec<Delivery> {
        let Some(after) = page.after.take() else { return Vec::new() };
        let after = match &after {
            Bound::Included(topic) => Bound::Included(topic.as_str()),
            Bound::Excluded(topic) => Bound::Excluded(topic.as_str()),
            Bound::Unbounded => Bound::Unbounded,
        };
        let start = fixed_start(&page.filter);
        let mut found = Vec::new();
        for (seen, (topic, kept)) in self.topics.range::<str, _>((after, Bound::Unbounded)).enumerate() {
            if !topic.starts_with(start) {
                break;
            }
            if matches(topic, &page.filter) && !kept.message.is_expired(now) {
                let qos = if (kept.qos as u8) < (page.qos as u8) { kept.qos } else { page.qos };
                let message = Arc::clone(&kept.message);
                found.push(Delivery { message, qos, retain: true, dup: false, pkid: 0 });
            }
            if seen + 1 == topics_max {
                page.after = Some(Bound::Excluded(topic.to_string()));
                break;
            }
        }
        found
    }
}
