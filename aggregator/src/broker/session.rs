//! The broker's state of one client: subscriptions, queued messages, unacknowledged messages.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Instant;

use bytes::BytesMut;
use rumqttc::v5::mqttbytes::v5::{Packet, PubRel, Publish};

use super::handshakes::Handshakes;
use super::memory::{Budget, Charge};
use super::message::Delivery;
use super::packet::{self, Version};
use super::retained::{Page, Retained};
use super::subscription::{Subscription, ids, wanted};

/// Limit on answers queued for one client. While it is reached, no packet of the client is handled.
const ANSWERS_MAX: usize = 256;
/// Limit on the subscriptions of one client.
pub(super) const SUBSCRIPTIONS_MAX: usize = 32;
/// Retained messages that are looked at before a client's other messages have their turn.
const PAGE: usize = 256;
/// What a session takes without messages and subscriptions, bytes.
const SESSION_BYTES: usize = 1024;
/// What a queued message takes beside the message itself, bytes.
const DELIVERY_BYTES: usize = 2 * size_of::<Delivery>();
/// What a queued answer takes, bytes.
const ANSWER_BYTES: usize = size_of::<Packet>() + 64;

/// The state of one client, connected or not.
#[derive(Debug)]
pub(super) struct Session {
    /// Number in the order of beginning.
    pub(super) number: u64,
    pub(super) subscriptions: Vec<Subscription>,
    queue: VecDeque<Delivery>,
    queue_bytes: usize,
    /// Limit on the bytes of the queue.
    queue_bytes_max: usize,
    /// Messages that were sent with QoS 1 or 2 and not yet acknowledged, oldest first.
    in_flight: VecDeque<Delivery>,
    pub(super) handshakes: Handshakes,
    /// Retained messages of new subscriptions that are not queued yet.
    pages: VecDeque<Page>,
    last_pkid: u16,
    pub(super) link: Option<Link>,
    /// Messages that the client has missed since it last had an empty queue.
    pub(super) missed: u64,
    /// Time at which the session is dropped; `None` while the client is connected.
    pub(super) expires: Option<Instant>,
    /// The last will that waits for its delay, and the time at which it is published.
    pub(super) will: Option<(Instant, Publish)>,
    charge: Charge,
}

/// The connection of a session.
#[derive(Debug)]
pub(super) struct Link {
    /// Number of the connection; a newer connection may take the session over.
    pub(super) id: usize,
    pub(super) version: Version,
    /// Limit on messages that were sent with QoS 1 or 2 and not yet acknowledged.
    pub(super) receive_max: usize,
    /// The largest packet that the client accepts.
    pub(super) packet_bytes_max: usize,
    /// The last will, which is published unless the client ends the connection gracefully.
    pub(super) will: Option<Publish>,
    /// Seconds that the last will waits.
    pub(super) will_delay_s: u32,
    /// How long the session outlives the connection, seconds.
    pub(super) expiry_s: u32,
    answers: VecDeque<Packet>,
}

impl Link {
    pub(super) fn new(id: usize, version: Version) -> Self {
        Self {
            id,
            version,
            receive_max: usize::from(u16::MAX),
            packet_bytes_max: usize::MAX,
            will: None,
            will_delay_s: 0,
            expiry_s: 0,
            answers: VecDeque::new(),
        }
    }
}

impl Session {
    pub(super) fn new(budget: &Arc<Budget>, queue_bytes_max: usize, number: u64) -> Self {
        Self {
            number,
            subscriptions: Vec::new(),
            queue: VecDeque::new(),
            queue_bytes: 0,
            queue_bytes_max,
            in_flight: VecDeque::new(),
            handshakes: Handshakes::default(),
            pages: VecDeque::new(),
            last_pkid: 0,
            link: None,
            missed: 0,
            expires: None,
            will: None,
            charge: Charge::new(budget, SESSION_BYTES),
        }
    }

    /// This client's subscription to `topic` with the highest QoS, if there is one. If the client itself
    /// publishes the message (`is_own`), its subscriptions with the option "no local" do not count.
    pub(super) fn wants(&self, topic: &str, is_own: bool) -> Option<&Subscription> {
        wanted(&self.subscriptions, topic, is_own)
    }

    /// Whether there is no room for another message of `bytes`. An empty queue has room for any message.
    pub(super) fn is_full(&self, bytes: usize) -> bool {
        self.queue_bytes > 0 && self.queue_bytes + bytes > self.queue_bytes_max
    }

    /// Whether too many answers are queued. The client's next packet must then wait until the client has read some.
    pub(super) fn is_flooded(&self) -> bool {
        self.link.as_ref().is_some_and(|link| link.answers.len() >= ANSWERS_MAX)
    }

    /// Whether there is something to write.
    pub(super) fn has_work(&self) -> bool {
        self.link.as_ref().is_some_and(|link| {
            let may_send = |next: &Delivery| !next.is_acknowledged() || self.unfinished() < link.receive_max;
            !link.answers.is_empty()
                || self.queue.front().is_some_and(may_send)
                || (self.queue.is_empty() && !self.pages.is_empty())
        })
    }

    /// Bytes that the client keeps in the broker: its session, and all messages that wait for it.
    pub(super) fn weight(&self) -> usize {
        self.charge.bytes()
            + self.queue_bytes
            + self.in_flight.iter().map(|sent| sent.message.bytes()).sum::<usize>()
    }

    /// Messages that were sent with QoS 1 or 2 and that the client has not finished.
    fn unfinished(&self) -> usize {
        self.in_flight.len() + self.handshakes.released().len()
    }

    /// Queues a message, even in a full queue. Messages with QoS 0 do not wait for a disconnected client.
    pub(super) fn enqueue(&mut self, delivery: Delivery) {
        if self.link.is_some() || delivery.is_acknowledged() {
            self.queue_bytes += delivery.message.bytes();
            self.queue.push_back(delivery);
            self.weigh();
        }
    }

    /// Drops the oldest message that waits; returns whether there was one.
    pub(super) fn drop_oldest(&mut self) -> bool {
        let Some(delivery) = self.queue.pop_front() else { return false };
        self.queue_bytes -= delivery.message.bytes();
        self.missed += 1;
        self.weigh();
        true
    }

    /// Queues an answer to the client's own packet.
    pub(super) fn answer(&mut self, packet: Packet) {
        if let Some(link) = &mut self.link {
            link.answers.push_back(packet);
            self.weigh();
        }
    }

    /// Adds the retained messages that match a new subscription. They are queued as the client takes them.
    pub(super) fn open(&mut self, page: Page) {
        self.pages.retain(|old| old.filter != page.filter);
        self.pages.push_back(page);
        self.weigh();
    }

    /// Forgets a subscription, and returns it if there was one.
    pub(super) fn unsubscribe(&mut self, path: &str) -> Option<Subscription> {
        let place = self.subscriptions.iter().position(|subscription| subscription.path() == path)?;
        let subscription = self.subscriptions.remove(place);
        self.pages.retain(|page| page.filter != path);
        self.weigh();
        Some(subscription)
    }

    /// Writes what the client gets next to `out`: all answers, then messages until `out` has `bytes_max` bytes or the
    /// client accepts no more.
    pub(super) fn write(&mut self, now: Instant, retained: &Retained, bytes_max: usize, out: &mut BytesMut) {
        let Some(link) = &mut self.link else { return };
        for answer in link.answers.drain(..) {
            packet::write(&answer, link.version, out);
        }
        let (version, receive_max, packet_bytes_max) =
            (link.version, link.receive_max, link.packet_bytes_max);
        while out.len() < bytes_max {
            self.turn_page(now, retained);
            let Some(next) = self.queue.front() else { break };
            if next.is_acknowledged() && self.unfinished() >= receive_max {
                break;
            }
            let Some(delivery) = self.pop() else { break };
            let ids = ids(&self.subscriptions, delivery.message.topic());
            if delivery.message.is_expired(now) && !delivery.dup {
                self.forget(&delivery);
            } else if !delivery.write(now, version, packet_bytes_max, ids, out) {
                // MQTT demands that the client misses packets that it finds too large.
                self.forget(&delivery);
            }
        }
        if self.queue.is_empty() {
            self.missed = 0;
        }
        self.weigh();
    }

    /// Queues retained messages if nothing else waits.
    fn turn_page(&mut self, now: Instant, retained: &Retained) {
        while self.queue.is_empty() {
            let Some(mut page) = self.pages.pop_front() else { return };
            for delivery in retained.turn(&mut page, now, PAGE) {
                self.queue_bytes += delivery.message.bytes();
                self.queue.push_back(delivery);
            }
            if !page.is_over() {
                self.pages.push_back(page);
                return;
            }
        }
    }

    /// Removes a message that the client has acknowledged; returns whether there was one.
    pub(super) fn acknowledge(&mut self, pkid: u16) -> bool {
        let before = self.in_flight.len();
        self.in_flight.retain(|sent| sent.pkid != pkid);
        self.weigh();
        self.in_flight.len() < before
    }

    /// Handles PUBREC, by which a client takes a message of QoS 2, or refuses it.
    pub(super) fn release(&mut self, pkid: u16, is_taken: bool) {
        let was_sent = self.acknowledge(pkid);
        if is_taken {
            let answer = self.handshakes.release(pkid, was_sent);
            self.answer(Packet::PubRel(answer));
        }
    }

    /// Tells a client that has come back again which messages it may release.
    pub(super) fn resume(&mut self) {
        let again: Vec<u16> = self.handshakes.released().collect();
        again.into_iter().for_each(|pkid| self.answer(Packet::PubRel(PubRel::new(pkid, None))));
    }

    /// Ends the connection: QoS 0 messages are dropped, and unacknowledged messages go back to the front of
    /// the queue.
    pub(super) fn unlink(&mut self) -> Option<Link> {
        let link = self.link.take();
        self.queue.retain(Delivery::is_acknowledged);
        while let Some(mut delivery) = self.in_flight.pop_back() {
            delivery.dup = true;
            self.queue.push_front(delivery);
        }
        self.queue_bytes = self.queue.iter().map(|delivery| delivery.message.bytes()).sum();
        self.weigh();
        link
    }

    fn pop(&mut self) -> Option<Delivery> {
        let mut delivery = self.queue.pop_front()?;
        self.queue_bytes -= delivery.message.bytes();
        if delivery.is_acknowledged() {
            // A message sent on an earlier connection keeps its packet id.
            if delivery.pkid == 0 {
                delivery.pkid = self.next_pkid();
            }
            self.in_flight.push_back(delivery.clone());
        }
        Some(delivery)
    }

    /// Undoes what [`Self::pop`] has kept of a message that is not sent.
    fn forget(&mut self, delivery: &Delivery) {
        if delivery.is_acknowledged() {
            self.in_flight.pop_back();
        }
    }

    /// A packet id that no unacknowledged message has. The search ends, because there are more ids than such
    /// messages.
    fn next_pkid(&mut self) -> u16 {
        loop {
            self.last_pkid = self.last_pkid.checked_add(1).unwrap_or(1);
            let is_free = |delivery: &Delivery| delivery.pkid != self.last_pkid;
            if !self.handshakes.is_released(self.last_pkid)
                && self.in_flight.iter().all(is_free)
                && self.queue.iter().take_while(|next| next.dup).all(is_free)
            {
                return self.last_pkid;
            }
        }
    }

    /// Adjusts what the session takes from the budget.
    pub(super) fn weigh(&mut self) {
        let subscriptions: usize = self.subscriptions.iter().map(Subscription::bytes).sum();
        let pages: usize = self.pages.iter().map(Page::bytes).sum();
        let (link, delayed) = (self.link.as_ref(), self.will.as_ref().map(|(_, will)| will));
        let will = link.and_then(|link| link.will.as_ref()).or(delayed).map_or(0, super::message::cost);
        let answers = link.map_or(0, |link| link.answers.len() * ANSWER_BYTES);
        let deliveries = (self.queue.len() + self.in_flight.len()) * DELIVERY_BYTES;
        let kept = subscriptions + pages + will + answers + deliveries + self.handshakes.bytes();
        self.charge.resize(SESSION_BYTES + kept);
    }
}
