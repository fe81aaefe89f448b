//! The thread that drives rumqttc's event loop.

use std::io::ErrorKind;
use std::pin::pin;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::{SyncSender, TrySendError};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use cosurf_wire::{MAX_MESSAGE_BYTES, MAX_TOPIC_BYTES};
use rumqttc::v5::mqttbytes::v5::{
    ConnAck, ConnectReturnCode, DisconnectReasonCode, Filter, LastWill, Packet, Publish, RetainForwardRule,
    Subscribe, SubscribeReasonCode,
};
use rumqttc::v5::mqttbytes::{Error as MqttError, QoS};
use rumqttc::v5::{AsyncClient, ConnectionError, Event, EventLoop, MqttOptions, Request, StateError};
use rumqttc::{TlsConfiguration, Transport as TlsTransport};
use tokio::time::{Instant, sleep, timeout};

use super::config::{EVENTS_MAX, Login, MqttConfig, PACKET_OVERHEAD_BYTES};
use super::refusal::tls_fault;
use crate::pacing::Backoff;
use crate::transport::{Outgoing, TransportEvent};

/// Maximum number of messages that wait for the event loop, and also of unacknowledged messages: 16 chunks of
/// 64 KiB are 1 MiB.
const QUEUE_MAX: usize = 16;
/// Largest packet that this client accepts, in bytes.
pub(super) const PACKET_BYTES_MAX: usize = MAX_MESSAGE_BYTES + MAX_TOPIC_BYTES + PACKET_OVERHEAD_BYTES;
/// Interval of MQTT pings. The broker detects a dead connection within one and a half intervals, the client
/// within two.
const KEEP_ALIVE: Duration = Duration::from_secs(30);
/// The broker keeps the session of a disconnected client for this long: enough for a battery change.
const SESSION_EXPIRY_S: u32 = 3600;
const CONNECT_TIMEOUT_S: u64 = 5;
/// Delays between attempts to connect.
const RECONNECT: Backoff = Backoff::new(Duration::from_millis(200), Duration::from_secs(5));
/// A client that gets no acknowledgement for this long is replaced. At 3 kB/s, a chunk of 64 KiB takes less
/// time.
const ACKNOWLEDGEMENT_TIMEOUT: Duration = Duration::from_secs(if cfg!(test) { 1 } else { 30 });
/// Interval at which missing acknowledgements and a request to stop are checked.
const TICK: Duration = Duration::from_millis(50);
/// How long the worker sends queued messages before it stops.
const STOP_TIMEOUT: Duration = Duration::from_secs(2);
/// How long a full event queue holds back the connection. After that, messages are dropped.
const DELIVERY_TIMEOUT: Duration = Duration::from_secs(5);

/// The state that the caller's thread and the worker's thread share.
#[derive(Debug)]
pub(super) struct Shared {
    client: Mutex<Option<AsyncClient>>,
    /// Largest packet that the broker accepts, in bytes; `usize::MAX` before the connection or if the broker
    /// names no limit.
    pub(super) packet_bytes_max: AtomicUsize,
    /// Number of published messages that the broker has not acknowledged.
    pub(super) unacknowledged: AtomicUsize,
    pub(super) is_stopping: AtomicBool,
}

impl Default for Shared {
    fn default() -> Self {
        Self {
            client: Mutex::new(None),
            packet_bytes_max: AtomicUsize::new(usize::MAX),
            unacknowledged: AtomicUsize::new(0),
            is_stopping: AtomicBool::new(false),
        }
    }
}

impl Shared {
    /// The current client; `None` before the first one is made.
    pub(super) fn client(&self) -> Option<AsyncClient> {
        self.client.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn set_client(&self, client: AsyncClient) {
        *self.client.lock().unwrap_or_else(PoisonError::into_inner) = Some(client);
    }

    /// Counts one message as acknowledged.
    pub(super) fn count_acknowledgement(&self) {
        let decrement = |count: usize| count.checked_sub(1);
        let _ = self.unacknowledged.fetch_update(Ordering::Relaxed, Ordering::Relaxed, decrement);
    }
}

pub(super) struct Worker {
    config: MqttConfig,
    shared: Arc<Shared>,
    events: SyncSender<TransportEvent>,
    is_connected: bool,
    attempt: u32,
    reconnect: Backoff,
    last_progress: Instant,
    is_dropping: bool,
}

/// Why the event loop of a client ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Exit {
    /// The caller has dropped the transport.
    Stop,
    /// A new client must take the place of this one.
    Replace,
}

impl Worker {
    pub(super) fn new(config: MqttConfig, shared: Arc<Shared>, events: SyncSender<TransportEvent>) -> Self {
        Self {
            config,
            shared,
            events,
            is_connected: false,
            attempt: 0,
            reconnect: RECONNECT,
            last_progress: Instant::now(),
            is_dropping: false,
        }
    }

    pub(super) fn run(mut self) {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
        match runtime {
            Ok(runtime) => runtime.block_on(async { while self.drive().await == Exit::Replace {} }),
            Err(error) => {
                let reason = format!("broker {}: cannot start the I/O: {error}", self.config.broker);
                let _ = self.events.send(TransportEvent::Disconnected { attempt: 1, reason });
            }
        }
    }

    /// Runs one client until it must stop or be replaced.
    async fn drive(&mut self) -> Exit {
        let (client, mut eventloop) = AsyncClient::new(self.options(), QUEUE_MAX);
        self.shared.set_client(client);
        self.shared.unacknowledged.store(0, Ordering::Relaxed);
        self.is_connected = false;
        loop {
            let exit = match self.poll(&mut eventloop).await {
                Ok(Ok(event)) => self.on_event(&mut eventloop, event).await,
                Ok(Err(error)) => self.on_error(&error).await,
                Err(exit) => Some(exit),
            };
            if let Some(exit) = exit {
                return exit;
            }
        }
    }

    /// Waits for the next event. An unfinished future of [`EventLoop::poll`] is dropped only when the client
    /// ends: dropping it earlier would abort a connection attempt.
    async fn poll(&mut self, eventloop: &mut EventLoop) -> Result<Result<Event, ConnectionError>, Exit> {
        let mut poll = pin!(eventloop.poll());
        let mut stopping_since = None;
        loop {
            if let Ok(event) = timeout(TICK, poll.as_mut()).await {
                return Ok(event);
            }
            let is_idle = self.shared.unacknowledged.load(Ordering::Relaxed) == 0;
            if is_idle || !self.is_connected {
                self.last_progress = Instant::now();
            }
            if self.is_stopping() {
                let since = *stopping_since.get_or_insert_with(Instant::now);
                if is_idle || !self.is_connected || since.elapsed() > STOP_TIMEOUT {
                    return Err(Exit::Stop);
                }
            }
            if self.last_progress.elapsed() > ACKNOWLEDGEMENT_TIMEOUT {
                return Err(self.on_no_acknowledgement().await);
            }
        }
    }

    async fn on_event(&mut self, eventloop: &mut EventLoop, event: Event) -> Option<Exit> {
        match event {
            Event::Incoming(Packet::ConnAck(ack)) => self.on_connack(eventloop, &ack),
            Event::Incoming(Packet::SubAck(ack)) => {
                let is_granted = |code: &SubscribeReasonCode| matches!(code, SubscribeReasonCode::Success(_));
                if !ack.return_codes.iter().all(is_granted) {
                    let reason = "subscriptions refused: give this device access to its topics";
                    self.fail(reason).await;
                    return self.pause().await.or(Some(Exit::Replace));
                }
                self.is_connected = true;
                self.attempt = 0;
                self.reconnect.reset();
                self.deliver(TransportEvent::Connected).await;
            }
            Event::Incoming(Packet::PubAck(_)) => {
                self.shared.count_acknowledgement();
                self.last_progress = Instant::now();
            }
            Event::Incoming(Packet::Publish(publish)) => self.on_publish(publish).await,
            _ => {}
        }
        None
    }

    /// Subscribes first, so that the messages left over from an earlier connection are sent after the
    /// subscription.
    fn on_connack(&mut self, eventloop: &mut EventLoop, ack: &ConnAck) {
        let announced = ack.properties.as_ref().and_then(|properties| properties.max_packet_size);
        let limit = announced.map_or(usize::MAX, |bytes| bytes as usize);
        self.shared.packet_bytes_max.store(limit, Ordering::Relaxed);
        if !ack.session_present {
            self.shared.unacknowledged.store(0, Ordering::Relaxed);
        }
        self.last_progress = Instant::now();
        let filters = self.config.identity.filters();
        let filters = filters.iter().map(|path| Filter {
            path: path.as_str().to_owned(),
            qos: QoS::AtLeastOnce,
            nolocal: true,
            preserve_retain: false,
            retain_forward_rule: RetainForwardRule::OnEverySubscribe,
        });
        eventloop.pending.push_front(Request::Subscribe(Subscribe::new_many(filters, None)));
    }

    async fn on_publish(&mut self, publish: Publish) {
        // Topics of the protocol are ASCII. The node drops messages under other topics.
        let topic = String::from_utf8_lossy(&publish.topic).into_owned();
        let payload = publish.payload.to_vec();
        self.deliver(TransportEvent::Incoming { topic, payload }).await;
    }

    async fn on_error(&mut self, error: &ConnectionError) -> Option<Exit> {
        self.fail(&describe(error)).await;
        let is_too_large = matches!(error, ConnectionError::MqttState(state) if is_too_large(state));
        let stop = self.pause().await;
        stop.or(is_too_large.then_some(Exit::Replace))
    }

    async fn on_no_acknowledgement(&mut self) -> Exit {
        self.fail(&format!("no acknowledgement for {ACKNOWLEDGEMENT_TIMEOUT:?}; starting a new client"))
            .await;
        Exit::Replace
    }

    async fn fail(&mut self, what: &str) {
        self.is_connected = false;
        self.attempt += 1;
        let attempt = self.attempt;
        let reason = format!("broker {}: {what}", self.config.broker);
        self.deliver(TransportEvent::Disconnected { attempt, reason }).await;
    }

    /// Waits before the next attempt to connect, but not once the transport is dropped.
    async fn pause(&mut self) -> Option<Exit> {
        let until = Instant::now() + self.reconnect.delay();
        while Instant::now() < until && !self.is_stopping() {
            sleep(TICK).await;
        }
        self.is_stopping().then_some(Exit::Stop)
    }

    /// Queues an event for the caller. While the queue is full, the connection is held back for up to
    /// [`DELIVERY_TIMEOUT`] (backpressure). After that, messages are dropped until the queue has room, so
    /// that the connection stays alive.
    async fn deliver(&mut self, mut event: TransportEvent) {
        let until = Instant::now() + DELIVERY_TIMEOUT;
        let is_message = matches!(event, TransportEvent::Incoming { .. });
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

    fn options(&self) -> MqttOptions {
        let MqttConfig { broker, identity, will, tls, login } = &self.config;
        let mut options = MqttOptions::new(identity.client_id(), broker.socket_host(), broker.port);
        let in_flight = QUEUE_MAX as u16;
        options
            .set_keep_alive(KEEP_ALIVE)
            .set_clean_start(false)
            .set_session_expiry_interval(Some(SESSION_EXPIRY_S))
            .set_connection_timeout(CONNECT_TIMEOUT_S)
            .set_max_packet_size(Some(PACKET_BYTES_MAX as u32))
            .set_receive_maximum(Some(EVENTS_MAX as u16 / 2))
            .set_outgoing_inflight_upper_limit(in_flight);
        if let Some(Outgoing { topic, payload, retain }) = will.clone() {
            options.set_last_will(LastWill::new(topic.as_str(), payload, QoS::AtLeastOnce, retain, None));
        }
        if let Some(Login { user, password }) = login {
            options.set_credentials(user, password);
        }
        if let Some(tls) = tls {
            options
                .set_transport(TlsTransport::tls_with_config(TlsConfiguration::Rustls(Arc::clone(&tls.0))));
        }
        options
    }
}

fn is_too_large(error: &StateError) -> bool {
    matches!(
        error,
        StateError::OutgoingPacketTooLarge { .. }
            | StateError::Deserialization(MqttError::OutgoingPacketTooLarge { .. })
    )
}

/// Describes an error in a few words.
pub(super) fn describe(error: &ConnectionError) -> String {
    if let Some(told) = tls_fault(error) {
        return told;
    }
    match error {
        ConnectionError::Io(error) | ConnectionError::MqttState(StateError::Io(error)) => {
            match error.kind() {
                ErrorKind::ConnectionRefused => "connection refused".to_owned(),
                _ => error.to_string(),
            }
        }
        ConnectionError::Timeout(_) => "no answer".to_owned(),
        ConnectionError::Tls(error) => format!("TLS: {error}"),
        ConnectionError::ConnectionRefused(code) => match code {
            ConnectReturnCode::NotAuthorized | ConnectReturnCode::BadUserNamePassword => {
                "the broker does not accept this name and password: check them".to_owned()
            }
            code => format!("connection refused: {code:?}"),
        },
        ConnectionError::MqttState(
            StateError::ConnectionAborted | StateError::Deserialization(MqttError::Io(_)),
        ) => "connection lost".to_owned(),
        ConnectionError::MqttState(StateError::AwaitPingResp) => "no reply to a ping".to_owned(),
        ConnectionError::MqttState(StateError::ServerDisconnect { reason_code, .. }) => match reason_code {
            DisconnectReasonCode::SessionTakenOver => {
                "another program connected under the same name: give every device its own name".to_owned()
            }
            code => format!("connection closed by the broker: {code:?}"),
        },
        other => other.to_string(),
    }
}
