//! What the caller's thread and the client's thread share.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::Publish;
use tokio::sync::Notify;

use super::session::Letter;
use super::settings::PACKET_OVERHEAD_BYTES;
use crate::transport::{PublishError, is_chunk, is_made_up_for};

/// Maximum number of control messages that wait to be sent, and of bulk messages.
const QUEUE_MAX: usize = 16;

/// What a client tells its caller.
#[derive(Debug)]
pub(super) enum ClientEvent {
    /// The connection is up, with all its subscriptions. Messages sent earlier may be lost.
    Connected,
    /// The connection is up again, and the broker has kept the session. The chunks under these topics may be lost.
    Resumed { lost: Vec<String> },
    /// The connection was lost or could not be made, for this number of times since the last one that lasted.
    Disconnected { attempt: u32, reason: String },
    /// The broker does not take a message.
    Denied { reason: String },
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
    pub(super) fn new() -> Self {
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

    /// Queues a message for sending.
    pub(super) fn push(&self, topic: &str, payload: &[u8], retain: bool) -> Result<(), PublishError> {
        let bytes = topic.len() + payload.len() + PACKET_OVERHEAD_BYTES;
        let max_bytes = self.packet_bytes_max.load(Ordering::Relaxed);
        if bytes > max_bytes {
            return Err(PublishError::TooLarge { bytes, max_bytes });
        }
        let mut publish = Publish::new(topic, QoS::AtLeastOnce, payload.to_vec(), None);
        publish.retain = retain;
        let letter = Letter { publish, is_bulk: is_chunk(topic), is_made_up_for: is_made_up_for(topic) };
        let mut queues = self.queues();
        let queue = if letter.is_bulk { &mut queues.bulk } else { &mut queues.control };
        if queue.len() >= QUEUE_MAX {
            return Err(PublishError::Busy);
        }
        queue.push_back(letter);
        // Counted while the message cannot be taken yet.
        self.pending.fetch_add(1, Ordering::Relaxed);
        drop(queues);
        self.wake.notify_one();
        Ok(())
    }

    /// Takes the next message that may be sent: control before bulk.
    pub(super) fn next(&self, may_send: impl Fn(&Letter) -> bool) -> Option<Letter> {
        let mut queues = self.queues();
        let Queues { control, bulk } = &mut *queues;
        let queue = if control.is_empty() { bulk } else { control };
        if may_send(queue.front()?) { queue.pop_front() } else { None }
    }

    /// Drops the bulk that waits, because the connection is lost. Returns its topics.
    pub(super) fn drop_bulk(&self) -> Vec<String> {
        let dropped: Vec<String> = self.queues().bulk.drain(..).map(|letter| letter.topic()).collect();
        self.settle(dropped.len());
        dropped
    }

    /// Counts messages that are acknowledged or given up.
    pub(super) fn settle(&self, count: usize) {
        self.pending.fetch_sub(count, Ordering::Relaxed);
    }
}
