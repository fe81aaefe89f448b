//! A simulated broker in memory, on virtual time, with faults drawn from a seed. Whole fleets run on it in
//! one test thread.
//!
//! Every delivery may be lost, duplicated, damaged, truncated or delayed, and delays reorder messages
//! ([`Faults`]). Each client has its own line to the broker, with its own bandwidth and outages. The broker
//! can be restarted, with or without its retained messages.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::rc::Rc;
use std::time::Duration;

use crate::faults::{Arrival, Faults, Line, OutagePlan};
use crate::identity::Identity;
use crate::transport::{Outgoing, PublishError, Transport, TransportEvent, counts_retained};

/// Maximum number of deliveries on their way from one client. Once it is reached, publishing fails with
/// [`PublishError::Busy`].
const QUEUE_MAX: usize = 64;

/// The simulated broker. All clones are the same broker.
#[derive(Clone, Debug)]
pub struct MemoryNetwork(Rc<RefCell<Broker>>);

#[derive(Debug)]
struct Broker {
    now: Duration,
    seed: u64,
    faults: Faults,
    is_up: bool,
    clients: Vec<Client>,
    retained: BTreeMap<String, Vec<u8>>,
    packet_bytes_max: usize,
    /// Number of deliveries so far. It orders deliveries that arrive at the same time.
    deliveries: u64,
}

#[derive(Debug)]
struct Client {
    filters: Vec<String>,
    /// Line to the broker. It only limits bandwidth. The other faults happen on the line from the broker.
    up: Line,
    /// Line from the broker.
    down: Line,
    outages: Option<OutagePlan>,
    /// Deliveries on their way to this client, by time of arrival, then by order of sending.
    arriving: BTreeMap<(Duration, u64), Delivery>,
    /// Number of deliveries on their way from this client.
    in_flight: usize,
    has_left: bool,
}

impl Client {
    fn is_cut(&self) -> bool {
        self.outages.as_ref().is_some_and(OutagePlan::is_out)
    }
}

#[derive(Debug)]
struct Delivery {
    /// The client that sent the message; `None` if the broker sent it.
    from: Option<usize>,
    event: TransportEvent,
}

impl MemoryNetwork {
    /// Starts a broker. The same seed gives the same faults.
    pub fn new(seed: u64, faults: Faults) -> Self {
        Self(Rc::new(RefCell::new(Broker {
            now: Duration::ZERO,
            seed,
            faults,
            is_up: true,
            clients: Vec::new(),
            retained: BTreeMap::new(),
            packet_bytes_max: usize::MAX,
            deliveries: 0,
        })))
    }

    /// Adds a client with the subscriptions of `identity`.
    pub fn join(&self, identity: &Identity) -> MemoryTransport {
        self.join_with(identity.filters().iter().map(|filter| filter.as_str().to_owned()).collect())
    }

    /// Adds a client that receives all messages.
    pub fn join_all(&self) -> MemoryTransport {
        self.join_with(vec!["#".to_owned()])
    }

    fn join_with(&self, filters: Vec<String>) -> MemoryTransport {
        let mut broker = self.0.borrow_mut();
        let client = broker.clients.len();
        let (now, faults) = (broker.now, broker.faults);
        let seed = broker.seed.wrapping_add((client as u64 + 1) << 32);
        let up = Faults { bytes_per_s: faults.bytes_per_s, ..Faults::NONE };
        let mut outages = faults.outages.map(|outages| OutagePlan::new(seed, outages));
        while let Some(plan) = outages.as_mut().filter(|plan| plan.changes_at() <= now) {
            plan.change();
        }
        broker.clients.push(Client {
            filters,
            up: Line::new(seed ^ 1, up),
            down: Line::new(seed, faults),
            outages,
            arriving: BTreeMap::new(),
            in_flight: 0,
            has_left: false,
        });
        if broker.is_up {
            broker.connect(client);
        }
        MemoryTransport { network: self.clone(), client }
    }

    /// The virtual time.
    pub fn now(&self) -> Duration {
        self.0.borrow().now
    }

    /// Advances virtual time to the next event, but at most to `until`. Events are the arrival of a message,
    /// and the start or end of an outage.
    pub fn advance(&self, until: Duration) {
        let mut broker = self.0.borrow_mut();
        let arrivals = broker.clients.iter().filter_map(|client| client.arriving.keys().next());
        let arrivals = arrivals.map(|(at, _)| *at);
        let changes = broker.clients.iter().filter_map(|client| client.outages.as_ref());
        let changes = changes.map(OutagePlan::changes_at);
        let next = arrivals.chain(changes).fold(until, Duration::min);
        broker.now = broker.now.max(next);
        (0..broker.clients.len()).for_each(|client| broker.update_outage(client));
    }

    /// Removes a client, as if its process had been killed. No last will is published.
    pub fn leave(&self, transport: MemoryTransport) {
        let mut broker = self.0.borrow_mut();
        broker.lose_arriving(transport.client);
        let client = &mut broker.clients[transport.client];
        client.filters.clear();
        client.outages = None;
        client.has_left = true;
    }

    /// Limits the size of messages to `bytes`, topic included.
    pub fn limit_packets(&self, bytes: usize) {
        self.0.borrow_mut().packet_bytes_max = bytes;
    }

    /// Stops the broker. Messages that have not arrived are lost, and all clients are disconnected.
    pub fn stop(&self, keep_retained: bool) {
        let mut broker = self.0.borrow_mut();
        broker.is_up = false;
        if !keep_retained {
            broker.retained.clear();
        }
        for client in 0..broker.clients.len() {
            broker.lose_arriving(client);
            let reason = "memory broker: stopped".to_owned();
            broker.notify(client, TransportEvent::Disconnected { attempt: 1, reason });
        }
    }

    /// Restarts the broker. All clients reconnect, except those whose line is in an outage.
    pub fn start(&self) {
        let mut broker = self.0.borrow_mut();
        broker.is_up = true;
        (0..broker.clients.len()).for_each(|client| broker.connect(client));
    }

    /// The retained message of a topic.
    pub fn retained(&self, topic: &str) -> Option<Vec<u8>> {
        self.0.borrow().retained.get(topic).cloned()
    }
}

impl Broker {
    /// Starts or ends an outage of a client's line if one is due.
    fn update_outage(&mut self, client: usize) {
        let now = self.now;
        let due = |plan: &&mut OutagePlan| plan.changes_at() <= now;
        let Some(plan) = self.clients[client].outages.as_mut().filter(due) else { return };
        plan.change();
        let is_out = plan.is_out();
        if is_out {
            self.lose_arriving(client);
            let reason = "memory broker: line cut".to_owned();
            self.notify(client, TransportEvent::Disconnected { attempt: 1, reason });
        } else if self.is_up {
            self.connect(client);
        }
    }

    fn lose_arriving(&mut self, client: usize) {
        for delivery in std::mem::take(&mut self.clients[client].arriving).into_values() {
            self.finish_delivery(&delivery);
        }
    }

    /// Counts a delivery that has arrived or was lost as no longer on its way.
    fn finish_delivery(&mut self, delivery: &Delivery) {
        if let Some(from) = delivery.from {
            self.clients[from].in_flight -= 1;
        }
    }

    fn connect(&mut self, client: usize) {
        if self.clients[client].is_cut() {
            return;
        }
        self.notify(client, TransportEvent::Connected);
        let filters = &self.clients[client].filters;
        let is_subscribed =
            |topic: &String| filters.iter().any(|filter| matches(filter, topic)) && counts_retained(topic);
        let kept: Vec<_> = self.retained.iter().filter(|(topic, _)| is_subscribed(topic)).collect();
        let kept: Vec<_> =
            kept.into_iter().map(|(topic, payload)| (topic.clone(), payload.clone())).collect();
        kept.iter().for_each(|(topic, payload)| self.deliver(self.now, None, client, topic, payload));
    }

    /// Sends a message to client `to` at time `at`. The client does not get the message during an outage.
    fn deliver(&mut self, at: Duration, from: Option<usize>, to: usize, topic: &str, payload: &[u8]) {
        if self.clients[to].is_cut() {
            return;
        }
        for Arrival { at, bytes } in self.clients[to].down.carry(at, payload) {
            let event = TransportEvent::Incoming { topic: topic.to_owned(), payload: bytes };
            self.enqueue(at, to, Delivery { from, event });
        }
    }

    fn notify(&mut self, client: usize, event: TransportEvent) {
        self.enqueue(self.now, client, Delivery { from: None, event });
    }

    fn enqueue(&mut self, at: Duration, to: usize, delivery: Delivery) {
        if self.clients[to].has_left {
            return;
        }
        self.deliveries += 1;
        if let Some(from) = delivery.from {
            self.clients[from].in_flight += 1;
        }
        self.clients[to].arriving.insert((at, self.deliveries), delivery);
    }
}

/// A client of a [`MemoryNetwork`]. Its `poll` never waits.
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
        let client = &broker.clients[self.client];
        if !broker.is_up || client.is_cut() || client.in_flight >= QUEUE_MAX {
            return Err(PublishError::Busy);
        }
        let topic = message.topic.as_str();
        if message.retain && message.payload.is_empty() {
            broker.retained.remove(topic);
        } else if message.retain {
            broker.retained.insert(topic.to_owned(), message.payload.clone());
        }
        let now = broker.now;
        let client = &mut broker.clients[self.client];
        client.up.carry(now, &message.payload);
        let at = client.up.free_at();
        for to in 0..broker.clients.len() {
            if broker.clients[to].filters.iter().any(|filter| matches(filter, topic)) {
                broker.deliver(at, Some(self.client), to, topic, &message.payload);
            }
        }
        Ok(())
    }

    fn poll(&mut self, _timeout: Duration) -> Option<TransportEvent> {
        let mut broker = self.network.0.borrow_mut();
        let now = broker.now;
        let first = broker.clients[self.client].arriving.first_entry()?;
        let delivery = (first.key().0 <= now).then(|| first.remove())?;
        broker.finish_delivery(&delivery);
        Some(delivery.event)
    }
}

/// Whether a topic matches a filter with MQTT wildcards.
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
