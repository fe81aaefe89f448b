//! The thread of a client: connects, subscribes, sends, receives, and connects again.

use std::collections::BTreeSet;
use std::future::Future;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::sync::mpsc::{SyncSender, TrySendError};
use std::time::{Duration, Instant};

use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{ConnAck, Packet, PingReq, PubAck, Publish, SubAck, SubscribeReasonCode};
use tokio::select;
use tokio::time::sleep;

use super::connection::Connection;
use super::fault::{Fault, denial, kind_of};
use super::session::InFlight;
use super::settings::{ClientSettings, KEEP_ALIVE_S};
use super::shared::{ClientEvent, Shared};
use crate::pacing::Backoff;
use crate::transport::is_want;

/// Delays between attempts to connect.
const RECONNECT: Backoff = Backoff::new(Duration::from_millis(10), Duration::from_secs(5));
/// The oldest message must be acknowledged within this time and [`SLOWEST_LINE`].
const ACKNOWLEDGEMENT_TIMEOUT: Duration = Duration::from_secs(if cfg!(test) { 1 } else { 30 });
/// The slowest line on which messages are still waited for, bytes per second.
const SLOWEST_LINE: f64 = 1000.0;
/// A connection that breaks within this time, or within [`LASTING_PAUSES`] times the pause before it, has not lasted, and the
/// next pause is twice as long. Two programs of one name end each other's connections after the pause of the other, which may
/// be twice as long as the own one.
const LASTING: Duration = Duration::from_millis(150);
const LASTING_PAUSES: u32 = 4;
/// Those pauses. They stay short, because a line that breaks that often may carry a little each time.
const PAUSES: Backoff = Backoff::new(Duration::from_millis(50), Duration::from_secs(1));
/// After so many connections in a row that did not last, the client tells what is likely.
const BROKEN_AT_ONCE: u32 = 3;
/// After so many connections that broke within the first message, the client asks the broker to drop what it has kept: a
/// message that the line cannot carry would keep back all that follow.
const FRUITLESS_MAX: u32 = 2;
/// A broker that has kept the session has its subscriptions too, and need not be asked for them again so soon after it has
/// granted them. After this time it is asked again, if the connection is another one: it may have dropped messages of the
/// session, of which subscribing brings back those that it retains, or it may have been restarted with an older session.
const SUBSCRIPTIONS_KEPT: Duration = Duration::from_secs(if cfg!(test) { 1 } else { 10 });
/// Interval at which timeouts and a request to stop are checked.
const TICK: Duration = Duration::from_millis(50);
/// How long the client sends queued messages before it stops.
const STOP_TIMEOUT: Duration = Duration::from_secs(2);
/// How long a full event queue holds back the connection. After that, messages are dropped.
const DELIVERY_TIMEOUT: Duration = Duration::from_secs(5);

pub(super) struct Worker {
    settings: ClientSettings,
    shared: Arc<Shared>,
    events: SyncSender<ClientEvent>,
    in_flight: InFlight,
    /// When the broker last acknowledged a message.
    acknowledged: Instant,
    /// Number of failures since the last connection that lasted.
    attempt: u32,
    reconnect: Backoff,
    /// Number of the last connections that did not last.
    broken_at_once: u32,
    /// Pauses after connections that did not last.
    pauses: Backoff,
    /// The last such pause; zero if the last connection had lasted.
    pause: Duration,
    is_dropping: bool,
    /// Whether there was a connection before.
    was_connected: bool,
    /// Topics of the bulk messages that were dropped since the last connection was ready.
    lost: Vec<String>,
    /// Number of the last connections that broke within a message before any message had arrived whole.
    fruitless: u32,
    /// When the subscriptions were last granted.
    granted: Option<Instant>,
    /// The kinds of messages that the broker has not taken on this connection.
    denied: BTreeSet<String>,
    stopping_since: Option<Instant>,
}

/// The state of one connection.
struct Line {
    connection: Connection,
    /// Whether the subscriptions are granted, or the broker still has those of the session. Before, nothing is published: an
    /// answer would be missed. To wait for the grant in a session as well would keep a slow line silent: first comes all
    /// that the broker has kept.
    is_ready: bool,
    has_session: bool,
    /// Whether the broker has acknowledged a message of this connection. What it kept while the client was away came before.
    is_caught_up: bool,
    /// Whether a message has arrived.
    is_fruitful: bool,
    /// Whether the broker serves the client: it has granted the subscriptions, or sent a message before.
    is_served: bool,
    /// Whether the client has subscribed on this connection, or has nothing to subscribe to.
    has_asked: bool,
    opened: Instant,
    /// Interval in which at least one packet is sent.
    keep_alive: Duration,
    /// When a ping was sent that nothing has followed.
    pinged: Option<Instant>,
    /// The broker's own limit on messages in flight.
    in_flight_max: Option<u16>,
}

impl Worker {
    pub(super) fn new(
        settings: ClientSettings,
        shared: Arc<Shared>,
        events: SyncSender<ClientEvent>,
    ) -> Self {
        Self {
            settings,
            shared,
            events,
            in_flight: InFlight::new(),
            acknowledged: Instant::now(),
            attempt: 0,
            reconnect: RECONNECT,
            broken_at_once: 0,
            pauses: PAUSES,
            pause: Duration::ZERO,
            is_dropping: false,
            was_connected: false,
            lost: Vec::new(),
            fruitless: 0,
            granted: None,
            denied: BTreeSet::new(),
            stopping_since: None,
        }
    }

    pub(super) fn run(mut self) {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
        match runtime {
            Ok(runtime) => {
                runtime.block_on(self.keep_connected());
                // A name that is still being looked up must not hold up the end.
                runtime.shutdown_background();
            }
            Err(error) => {
                let reason = format!("broker {}: cannot start the I/O: {error}", self.settings.broker);
                let _ = self.events.send(ClientEvent::Disconnected { attempt: 1, reason });
            }
        }
    }

    async fn keep_connected(&mut self) {
        while let Err(fault) = self.serve().await {
            let waiting = self.shared.drop_bulk();
            self.lost.extend(waiting);
            self.attempt += 1;
            let fault = match self.broken_at_once {
                times @ BROKEN_AT_ONCE.. => fault.after_breaks(times),
                _ => fault,
            };
            let reason = format!("broker {}: {fault}", self.settings.broker);
            self.deliver(ClientEvent::Disconnected { attempt: self.attempt, reason }).await;
            let delay = self.reconnect.delay().max(self.pause);
            if self.unless_stopping(sleep(delay)).await.is_none() {
                return;
            }
        }
    }

    /// Runs one connection, until the client is dropped.
    async fn serve(&mut self) -> Result<(), Fault> {
        let opening = Connection::open(&self.settings, self.fruitless >= FRUITLESS_MAX);
        let Some(opened) = self.unless_stopping(opening).await else { return Ok(()) };
        let (connection, ack) = opened?;
        let mut line = self.begin(connection, &ack);
        if line.is_ready {
            self.on_ready(&mut line).await;
        }
        let served = self.keep(&mut line).await;
        match line.is_fruitful {
            true => self.fruitless = 0,
            false => self.fruitless += u32::from(served.is_err() && line.connection.is_within_packet()),
        }
        self.judge(&line);
        served
    }

    /// Notes whether a connection that has ended had lasted.
    fn judge(&mut self, line: &Line) {
        if !line.is_served {
            return;
        }
        self.reconnect.reset();
        if line.opened.elapsed() < LASTING.max(LASTING_PAUSES * self.pause) {
            self.broken_at_once += 1;
            self.pause = self.pauses.delay();
            return;
        }
        (self.attempt, self.broken_at_once, self.pause) = (0, 0, Duration::ZERO);
        self.pauses.reset();
    }

    /// Receives and sends over a connection, until the client is dropped.
    async fn keep(&mut self, line: &mut Line) -> Result<(), Fault> {
        loop {
            while let Some(packet) = line.connection.next_packet()? {
                self.on_packet(packet, line).await?;
            }
            self.fill(line);
            if self.may_stop(line) {
                return Ok(());
            }
            select! {
                moved = line.connection.exchange() => moved?,
                () = self.shared.wake.notified() => {}
                () = sleep(TICK) => {}
            }
            self.watch(line)?;
        }
    }

    /// Waits for something, unless the client is dropped.
    async fn unless_stopping<T>(&self, what: impl Future<Output = T>) -> Option<T> {
        let stopping = async {
            while !self.is_stopping() {
                sleep(TICK).await;
            }
        };
        select! {
            done = what => Some(done),
            () = stopping => None,
        }
    }

    /// Takes what the broker says of itself, and subscribes.
    fn begin(&mut self, mut connection: Connection, ack: &ConnAck) -> Line {
        let said = ack.properties.as_ref();
        let limit = said.and_then(|said| said.max_packet_size);
        self.shared
            .packet_bytes_max
            .store(limit.map_or(usize::MAX, |bytes| bytes as usize), Ordering::Relaxed);
        let has_none = self.settings.filters.is_empty();
        let has_subscriptions = has_none || (ack.session_present && self.are_subscriptions_kept());
        if !has_subscriptions {
            connection.queue(&self.settings.subscription());
        }
        let keep_alive_s = said.and_then(|said| said.server_keep_alive).unwrap_or(KEEP_ALIVE_S);
        Line {
            connection,
            is_ready: has_subscriptions || ack.session_present,
            has_session: ack.session_present,
            is_caught_up: !ack.session_present,
            is_fruitful: false,
            is_served: has_subscriptions,
            has_asked: has_none || !has_subscriptions,
            opened: Instant::now(),
            keep_alive: Duration::from_secs(keep_alive_s.max(1).into()),
            pinged: None,
            in_flight_max: said.and_then(|said| said.receive_max),
        }
    }

    /// Sends what was left over from an earlier connection.
    async fn on_ready(&mut self, line: &mut Line) {
        line.is_ready = true;
        self.denied.clear();
        let (before, now) = (self.in_flight.len(), Instant::now());
        let lost = self.in_flight.bulk_topics().chain(std::mem::take(&mut self.lost)).collect();
        for message in self.in_flight.resume(line.has_session, line.in_flight_max, now) {
            line.connection.queue(&Packet::Publish(message.clone()));
        }
        self.shared.settle(before - self.in_flight.len());
        self.acknowledged = now;
        let is_resumed = std::mem::replace(&mut self.was_connected, true) && line.has_session;
        self.deliver(if is_resumed { ClientEvent::Resumed { lost } } else { ClientEvent::Connected }).await;
    }

    async fn on_packet(&mut self, packet: Packet, line: &mut Line) -> Result<(), Fault> {
        match packet {
            Packet::SubAck(ack) if !is_granted(&ack) => return Err(Fault::Subscriptions),
            Packet::SubAck(_) => {
                line.is_served = true;
                self.granted = Some(Instant::now());
                if !line.is_ready {
                    self.on_ready(line).await;
                }
            }
            Packet::PubAck(ack) => {
                line.is_caught_up = true;
                self.on_acknowledgement(&ack).await;
            }
            Packet::Publish(message) => {
                // Even if the line breaks before the subscriptions are granted.
                line.is_served = true;
                line.is_fruitful = true;
                let (id, qos) = (message.pkid, message.qos);
                if line.is_caught_up || !is_old_want(&message) {
                    self.on_message(message).await;
                }
                if qos == QoS::AtLeastOnce {
                    line.connection.queue(&Packet::PubAck(PubAck::new(id, None)));
                }
            }
            Packet::Disconnect(farewell) => return Err(Fault::Closed(farewell.reason_code)),
            _ => {}
        }
        Ok(())
    }

    async fn on_acknowledgement(&mut self, ack: &PubAck) {
        self.acknowledged = Instant::now();
        let Some(message) = self.in_flight.acknowledge(ack.pkid, self.acknowledged) else { return };
        self.shared.acknowledged.fetch_add(1, Ordering::Relaxed);
        self.shared.settle(1);
        let topic = String::from_utf8_lossy(&message.topic);
        if let Some(denial) = denial(ack.reason, &topic)
            && self.denied.insert(kind_of(&topic))
        {
            let reason = format!("broker {}: {denial}", self.settings.broker);
            self.deliver(ClientEvent::Denied { reason }).await;
        }
    }

    async fn on_message(&mut self, message: Publish) {
        // Topics of the protocol are ASCII. The node drops messages under other topics.
        let topic = String::from_utf8_lossy(&message.topic).into_owned();
        let (payload, qos, retain) = (message.payload.to_vec(), message.qos, message.retain);
        self.deliver(ClientEvent::Message { topic, payload, qos, retain }).await;
    }

    /// Sends the next message, if the one before has left and the line has room. So a control message overtakes all
    /// bulk that waits.
    fn fill(&mut self, line: &mut Line) {
        while line.is_ready && line.connection.is_flushed() {
            let Some(letter) = self.shared.next(|letter| self.in_flight.has_room_for(letter)) else { return };
            let limit = self.shared.packet_bytes_max.load(Ordering::Relaxed);
            // Queued before this broker told its limit. Whoever sent it will be told when it sends it again.
            if letter.publish.size() > limit {
                self.shared.settle(1);
                continue;
            }
            let message = self.in_flight.add(letter, Instant::now());
            line.connection.queue(&Packet::Publish(message.clone()));
        }
    }

    /// Whether the broker has granted the subscriptions just before.
    fn are_subscriptions_kept(&self) -> bool {
        self.granted.is_some_and(|at| at.elapsed() < SUBSCRIPTIONS_KEPT)
    }

    /// Subscribes again if it is time, pings, and checks that the broker answers.
    fn watch(&self, line: &mut Line) -> Result<(), Fault> {
        if !line.has_asked && !self.are_subscriptions_kept() {
            line.connection.queue(&self.settings.subscription());
            line.has_asked = true;
        }
        let Line { connection, keep_alive, pinged, .. } = line;
        if pinged.is_some_and(|at| connection.heard > at) {
            *pinged = None;
        }
        let is_quiet = connection.heard.min(connection.written).elapsed() >= *keep_alive;
        match pinged {
            None if is_quiet => {
                connection.queue(&Packet::PingReq(PingReq));
                *pinged = Some(Instant::now());
            }
            Some(at) if (*at).max(connection.written).elapsed() >= *keep_alive => return Err(Fault::NoReply),
            _ => {}
        }
        let Some((bytes, since)) = self.in_flight.oldest() else { return Ok(()) };
        let patience = ACKNOWLEDGEMENT_TIMEOUT + Duration::from_secs_f64(bytes as f64 / SLOWEST_LINE);
        let progress = since.max(self.acknowledged).max(connection.written);
        if progress.elapsed() > patience { Err(Fault::NoAcknowledgement) } else { Ok(()) }
    }

    /// Whether the client is dropped and has nothing more to send, or no time for it.
    fn may_stop(&mut self, line: &Line) -> bool {
        if !self.is_stopping() {
            return false;
        }
        let since = *self.stopping_since.get_or_insert_with(Instant::now);
        let is_idle = self.shared.pending.load(Ordering::Relaxed) == 0 && line.connection.is_flushed();
        is_idle || !line.is_ready || since.elapsed() > STOP_TIMEOUT
    }

    /// Queues an event for the caller. While the queue is full, the connection is held back for up to
    /// [`DELIVERY_TIMEOUT`] (backpressure). After that, messages are dropped until the queue has room, so
    /// that the connection stays alive.
    async fn deliver(&mut self, mut event: ClientEvent) {
        let until = Instant::now() + DELIVERY_TIMEOUT;
        let is_message = matches!(event, ClientEvent::Message { .. });
        loop {
            match self.events.try_send(event) {
                Ok(()) => {
                    self.is_dropping = false;
                    return;
                }
                Err(TrySendError::Disconnected(_)) => return,
                Err(TrySendError::Full(back)) => event = back,
            }
            let may_drop = is_message && (self.is_dropping || Instant::now() >= until);
            if may_drop || self.is_stopping() {
                self.is_dropping = true;
                return;
            }
            sleep(Duration::from_millis(1)).await;
        }
    }

    fn is_stopping(&self) -> bool {
        self.shared.is_stopping.load(Ordering::Relaxed)
    }
}

/// Whether a message that the broker has kept is of no use: a request for chunks that does not know what has arrived since.
/// If it were obeyed, chunks that arrived before the line broke would be sent again. The client offers its models at the
/// start of each connection, and the receiver's answer lists what it lacks now.
fn is_old_want(message: &Publish) -> bool {
    str::from_utf8(&message.topic).is_ok_and(is_want)
}

/// Whether the broker grants all subscriptions.
pub(super) fn is_granted(ack: &SubAck) -> bool {
    ack.return_codes.iter().all(|code| matches!(code, SubscribeReasonCode::Success(_)))
}
