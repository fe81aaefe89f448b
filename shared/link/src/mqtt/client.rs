//! An MQTT client on its own thread: what the caller's thread has of it.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{self, Connect, ConnectProperties, Filter, LastWill, Packet, Publish};
use tokio::sync::Notify;

use super::address::BrokerAddress;
use super::config::{EVENTS_MAX, Login, PACKET_BYTES_MAX, PACKET_OVERHEAD_BYTES};
use super::session::Letter;
use super::tls::Tls;
use super::worker::Worker;
use crate::transport::{Outgoing, PublishError, is_chunk};

/// Maximum number of control messages that wait to be sent, and of bulk messages.
const QUEUE_MAX: usize = 16;

/// What a client connects to, and as whom.
#[derive(Clone, Debug)]
pub(super) struct ClientSettings {
    pub(super) broker: BrokerAddress,
    pub(super) tls: Option<Tls>,
    pub(super) login: Option<Login>,
    pub(super) client_id: String,
    /// How long the broker keeps the session of this client while it is away, seconds; 0 for no longer than the
    /// connection.
    pub(super) session_expiry_s: u32,
    pub(super) will: Option<Outgoing>,
    pub(super) filters: Vec<Filter>,
}

/// Interval in which at least one packet is sent. The broker detects a dead connection within one and a half
/// intervals, the client within two.
pub(super) const KEEP_ALIVE_S: u16 = 30;

impl ClientSettings {
    /// The CONNECT packet.
    pub(super) fn hello(&self) -> Packet {
        let properties = ConnectProperties {
            session_expiry_interval: Some(self.session_expiry_s),
            receive_maximum: Some(EVENTS_MAX as u16 / 2),
            max_packet_size: Some(PACKET_BYTES_MAX as u32),
            ..ConnectProperties::new()
        };
        let connect = Connect {
            keep_alive: KEEP_ALIVE_S,
            client_id: self.client_id.clone(),
            clean_start: self.session_expiry_s == 0,
            properties: Some(properties),
        };
        let will = self.will.clone().map(|Outgoing { topic, payload, retain }| {
            LastWill::new(topic.as_str(), payload, QoS::AtLeastOnce, retain, None)
        });
        let login = self.login.clone().map(|Login { user, password }| v5::Login { username: user, password });
        Packet::Connect(connect, will, login)
    }
}

/// What a client tells its caller.
#[derive(Debug)]
pub(super) enum ClientEvent {
    /// The connection is up, with all its subscriptions.
    Connected,
    /// The connection was lost or could not be made, for this number of times since the last one.
    Disconnected { attempt: u32, reason: String },
    /// A message has arrived.
    Message { topic: String, payload: Vec<u8>, qos: QoS, retain: bool },
}

/// What the caller's thread and the client's thread share.
#[derive(Debug)]
pub(super) struct Shared {
    queues: Mutex<Queues>,
    /// Tells the client's thread of a new message.
    pub(super) wake: Notify,
    /// Largest packet that the broker accepts, in bytes; `usize::MAX` before the connection or if the broker
    /// names no limit.
    pub(super) packet_bytes_max: AtomicUsize,
    /// Number of messages that wait or are not acknowledged.
    pub(super) pending: AtomicUsize,
    /// Number of messages that were acknowledged.
    pub(super) acknowledged: AtomicUsize,
    pub(super) is_stopping: AtomicBool,
}

/// Messages that wait to be sent.
#[derive(Debug, Default)]
struct Queues {
    control: VecDeque<Letter>,
    bulk: VecDeque<Letter>,
}

impl Shared {
    fn new() -> Self {
        Self {
            queues: Mutex::default(),
            wake: Notify::new(),
            packet_bytes_max: AtomicUsize::new(usize::MAX),
            pending: AtomicUsize::new(0),
            acknowledged: AtomicUsize::new(0),
            is_stopping: AtomicBool::new(false),
        }
    }

    fn queues(&self) -> MutexGuard<'_, Queues> {
        self.queues.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes the next message that may be sent: control before bulk.
    pub(super) fn next(&self, may_send: impl Fn(&Letter) -> bool) -> Option<Letter> {
        let mut queues = self.queues();
        let Queues { control, bulk } = &mut *queues;
        let queue = if control.is_empty() { bulk } else { control };
        if may_send(queue.front()?) { queue.pop_front() } else { None }
    }

    /// Drops the bulk that waits: the connection is lost, and whoever sent it will be asked again for what is missing.
    pub(super) fn drop_bulk(&self) {
        let dropped = self.queues().bulk.drain(..).count();
        self.settle(dropped);
    }

    /// Counts messages that are acknowledged or given up.
    pub(super) fn settle(&self, count: usize) {
        self.pending.fetch_sub(count, Ordering::Relaxed);
    }
}

/// An MQTT client. When it is dropped, it sends what waits, for at most 2 seconds, and then breaks the connection
/// without a farewell, so that the broker publishes the last will.
#[derive(Debug)]
pub(super) struct Client {
    shared: Arc<Shared>,
    events: Receiver<ClientEvent>,
    thread: Option<JoinHandle<()>>,
}

impl Client {
    /// Starts connecting.
    pub(super) fn start(settings: ClientSettings) -> Self {
        let shared = Arc::new(Shared::new());
        let (sender, events) = sync_channel(EVENTS_MAX);
        let worker = Worker::new(settings, Arc::clone(&shared), sender);
        let thread = std::thread::spawn(move || worker.run());
        Self { shared, events, thread: Some(thread) }
    }

    /// Queues a message for sending.
    pub(super) fn publish(&self, topic: &str, payload: &[u8], retain: bool) -> Result<(), PublishError> {
        let bytes = topic.len() + payload.len() + PACKET_OVERHEAD_BYTES;
        let max_bytes = self.shared.packet_bytes_max.load(Ordering::Relaxed);
        if bytes > max_bytes {
            return Err(PublishError::TooLarge { bytes, max_bytes });
        }
        let mut publish = Publish::new(topic, QoS::AtLeastOnce, payload.to_vec(), None);
        publish.retain = retain;
        let letter = Letter { publish, is_bulk: is_chunk(topic) };
        let mut queues = self.shared.queues();
        let queue = if letter.is_bulk { &mut queues.bulk } else { &mut queues.control };
        if queue.len() >= QUEUE_MAX {
            return Err(PublishError::Busy);
        }
        queue.push_back(letter);
        // Counted while the message cannot be taken yet.
        self.shared.pending.fetch_add(1, Ordering::Relaxed);
        drop(queues);
        self.shared.wake.notify_one();
        Ok(())
    }

    /// Returns the next event, or `None` if there is none within `timeout`.
    pub(super) fn poll(&self, timeout: Duration) -> Option<ClientEvent> {
        self.events.recv_timeout(timeout).ok()
    }

    /// Number of messages that wait or are not acknowledged.
    pub(super) fn pending(&self) -> usize {
        self.shared.pending.load(Ordering::Relaxed)
    }

    /// Number of messages that were acknowledged.
    pub(super) fn acknowledged(&self) -> usize {
        self.shared.acknowledged.load(Ordering::Relaxed)
    }
}

impl Drop for Client {
    fn drop(&mut self) {
        self.shared.is_stopping.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A panic of the thread has already been printed.
            let _ = thread.join();
        }
    }
}
