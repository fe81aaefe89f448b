//! A broker in memory on virtual time, with faults from a seed: whole fleets in one test thread.
//!
//! Every delivery rolls its own dice: lost, doubled, damaged, delayed (so reordered). Connections can be
//! cut and the broker restarted, with or without its retained messages.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::rc::Rc;
use std::time::Duration;

use crate::node::Identity;
use crate::transport::{Outgoing, PublishError, Transport, TransportEvent};

/// Messages that one client may have under way; then it is told [`PublishError::Busy`].
const QUEUE_MAX: usize = 64;

/// What goes wrong, probabilities 0 to 1 per delivery.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Faults {
    /// A message is lost.
    pub loss: f64,
    /// A message comes twice.
    pub duplication: f64,
    /// A message has one byte changed.
    pub corruption: f64,
    /// A message takes up to this long, evenly; so what is sent later may come earlier.
    pub delay_max: Duration,
}

impl Faults {
    /// All well, at once.
    pub const NONE: Self = Self { loss: 0.0, duplication: 0.0, corruption: 0.0, delay_max: Duration::ZERO };
}

/// The broker. Clones share it.
#[derive(Clone, Debug)]
pub struct MemoryNetwork(Rc<RefCell<Broker>>);

#[derive(Debug)]
struct Broker {
    now: Duration,
    dice: Dice,
    faults: Faults,
    is_up: bool,
    clients: Vec<Client>,
    retained: BTreeMap<String, Vec<u8>>,
    packet_bytes_max: usize,
    /// Counts deliveries, so that those of one moment keep their order.
    deliveries: u64,
}

#[derive(Debug)]
struct Client {
    filters: Vec<String>,
    /// By time of arrival, then order of sending.
    arriving: BTreeMap<(Duration, u64), Delivery>,
}

#[derive(Debug)]
struct Delivery {
    /// Which client sent it; `None` for the broker's own.
    from: Option<usize>,
    event: TransportEvent,
}

impl MemoryNetwork {
    /// The same seed, the same faults.
    pub fn new(seed: u64, faults: Faults) -> Self {
        Self(Rc::new(RefCell::new(Broker {
            now: Duration::ZERO,
            dice: Dice(seed),
            faults,
            is_up: true,
            clients: Vec::new(),
            retained: BTreeMap::new(),
            packet_bytes_max: usize::MAX,
            deliveries: 0,
        })))
    }

    /// Joins a client with the subscriptions of `identity`.
    pub fn join(&self, identity: &Identity) -> MemoryTransport {
        let mut broker = self.0.borrow_mut();
        let filters = identity.filters().iter().map(|filter| filter.as_str().to_owned()).collect();
        broker.clients.push(Client { filters, arriving: BTreeMap::new() });
        let client = broker.clients.len() - 1;
        if broker.is_up {
            broker.connect(client);
        }
        MemoryTransport { network: self.clone(), client }
    }

    /// Virtual time.
    pub fn now(&self) -> Duration {
        self.0.borrow().now
    }

    /// Moves virtual time to `until`, or less far, to where the next message arrives.
    pub fn advance(&self, until: Duration) {
        let mut broker = self.0.borrow_mut();
        let next = broker.clients.iter().filter_map(|client| client.arriving.keys().next()).min();
        let next = next.map_or(until, |(at, _)| until.min(*at));
        broker.now = broker.now.max(next);
    }

    /// Takes no larger messages from now on.
    pub fn limit_packets(&self, bytes: usize) {
        self.0.borrow_mut().packet_bytes_max = bytes;
    }

    /// Stops the broker: all under way is lost and everyone is cut off.
    pub fn stop(&self, keep_retained: bool) {
        let mut broker = self.0.borrow_mut();
        broker.is_up = false;
        if !keep_retained {
            broker.retained.clear();
        }
        for client in 0..broker.clients.len() {
            broker.clients[client].arriving.clear();
            let reason = "memory broker: stopped (attempt 1)".to_owned();
            broker.tell(client, TransportEvent::Disconnected { attempt: 1, reason });
        }
    }

    /// Starts it again; everyone reconnects.
    pub fn start(&self) {
        let mut broker = self.0.borrow_mut();
        broker.is_up = true;
        (0..broker.clients.len()).for_each(|client| broker.connect(client));
    }

    /// What is retained under a topic.
    pub fn retained(&self, topic: &str) -> Option<Vec<u8>> {
        self.0.borrow().retained.get(topic).cloned()
    }
}

impl Broker {
    fn connect(&mut self, client: usize) {
        self.tell(client, TransportEvent::Connected);
        let filters = &self.clients[client].filters;
        let hears = |topic: &String| filters.iter().any(|filter| matches(filter, topic));
        let kept: Vec<_> = self.retained.iter().filter(|(topic, _)| hears(topic)).collect();
        let kept: Vec<_> =
            kept.into_iter().map(|(topic, payload)| (topic.clone(), payload.clone())).collect();
        kept.iter().for_each(|(topic, payload)| self.deliver(None, client, topic, payload));
    }

    /// Rolls the dice for one delivery.
    fn deliver(&mut self, from: Option<usize>, to: usize, topic: &str, payload: &[u8]) {
        let copies = 1 + u32::from(self.dice.falls(self.faults.duplication));
        for _ in 0..copies {
            if self.dice.falls(self.faults.loss) {
                continue;
            }
            let mut payload = payload.to_vec();
            if !payload.is_empty() && self.dice.falls(self.faults.corruption) {
                let place = self.dice.below(payload.len() as u64) as usize;
                payload[place] ^= 1 << self.dice.below(8);
            }
            let delay = self.dice.below(self.faults.delay_max.as_micros() as u64 + 1);
            let at = self.now + Duration::from_micros(delay);
            let event = TransportEvent::Incoming { topic: topic.to_owned(), payload };
            self.enqueue(at, to, Delivery { from, event });
        }
    }

    fn tell(&mut self, client: usize, event: TransportEvent) {
        self.enqueue(self.now, client, Delivery { from: None, event });
    }

    fn enqueue(&mut self, at: Duration, to: usize, delivery: Delivery) {
        self.deliveries += 1;
        self.clients[to].arriving.insert((at, self.deliveries), delivery);
    }

    fn under_way(&self, from: usize) -> usize {
        let sent = |delivery: &&Delivery| delivery.from == Some(from);
        self.clients.iter().map(|client| client.arriving.values().filter(sent).count()).sum()
    }
}

/// A client of a [`MemoryNetwork`]; `poll` never waits.
#[derive(Debug)]
pub struct MemoryTransport {
    network: MemoryNetwork,
    client: usize,
}

impl Transport for MemoryTransport {
    fn publish(&mut self, message: &Outgoing) -> Result<(), PublishError> {
        let mut broker = self.network.0.borrow_mut();
        let bytes = message.topic.len() + message.payload.len();
        if bytes > broker.packet_bytes_max {
            return Err(PublishError::TooLarge { bytes, max_bytes: broker.packet_bytes_max });
        }
        if !broker.is_up || broker.under_way(self.client) >= QUEUE_MAX {
            return Err(PublishError::Busy);
        }
        let topic = message.topic.as_str();
        if message.retain && message.payload.is_empty() {
            broker.retained.remove(topic);
        } else if message.retain {
            broker.retained.insert(topic.to_owned(), message.payload.clone());
        }
        for to in 0..broker.clients.len() {
            if broker.clients[to].filters.iter().any(|filter| matches(filter, topic)) {
                broker.deliver(Some(self.client), to, topic, &message.payload);
            }
        }
        Ok(())
    }

    fn poll(&mut self, _timeout: Duration) -> Option<TransportEvent> {
        let mut broker = self.network.0.borrow_mut();
        let now = broker.now;
        let first = broker.clients[self.client].arriving.first_entry()?;
        (first.key().0 <= now).then(|| first.remove().event)
    }
}

/// Whether a topic matches a filter with MQTT's wildcards.
fn matches(filter: &str, topic: &str) -> bool {
    let mut levels = topic.split('/');
    for wanted in filter.split('/') {
        match (wanted, levels.next()) {
            ("#", _) => return true,
            ("+", Some(_)) => {}
            (wanted, Some(level)) if wanted == level => {}
            _ => return false,
        }
    }
    levels.next().is_none()
}

/// SplitMix64 (Steele, Lea and Flood 2014).
#[derive(Debug)]
struct Dice(u64);

impl Dice {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// 0 to `limit - 1`; the bias is below 2⁻³² for the limits used here.
    fn below(&mut self, limit: u64) -> u64 {
        self.next() % limit
    }

    fn falls(&mut self, probability: f64) -> bool {
        (self.next() >> 11) as f64 / (1u64 << 53) as f64 * 1.0 < probability
    }
}
