//! Connects the device at the other end of a serial line to the broker, under the device's own name. Devices
//! on radio and devices on the network can thus share a mission, and the service treats both alike.
//!
//! When the device announces its birth (the start of a session), the gateway starts a client of the broker
//! in the device's name. When the line falls silent, this client ends without DISCONNECT, and the broker
//! publishes the device's last will. [`relay`] decides which messages pass; this file moves them.
//!
//! What it knows nothing about: models. Apart from topics, it looks only at birth notices and at the
//! device's lists of missing chunks.
//!
//! Where to start reading: [`Gateway::start`], then [`relay`].

mod pace;
mod relay;

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use cosurf_link::{
    Identity, MqttTransport, Outgoing, PublishError, SerialConfig, SerialTransport, Transport, TransportEvent,
};
use cosurf_wire::{DeviceId, SiteId};
use serde::Serialize;

use crate::broker::Reach;
use crate::quiet::Quiet;
use pace::Pace;
use relay::{Passage, Relay};

/// Longest wait for a message from the serial line before the messages of the broker have their turn.
const LISTEN: Duration = Duration::from_millis(10);
/// Requests of a device that pass at once, and the time after which one more passes.
const WANTS_MAX: u32 = 16;
const WANTS_EVERY: Duration = Duration::from_millis(400);
/// Shortest time between two clients that a line starts at the broker.
const BIRTHS_EVERY: Duration = Duration::from_secs(2);

/// What a gateway reports.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum GatewayEvent {
    /// A device has announced itself at the other end of a line.
    OnLine {
        /// The line's name.
        line: String,
        /// The device.
        device: DeviceId,
    },
    /// The line is silent, or its port cannot be opened.
    OffLine {
        /// The reason, as one line of text.
        reason: String,
    },
    /// A message was discarded.
    IgnoredOnLine {
        /// The line's name.
        line: String,
        /// Why it was discarded.
        reason: String,
    },
}

impl fmt::Display for GatewayEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::OnLine { line, device } => write!(f, "serial line {line}: {device} is connected"),
            Self::OffLine { reason } => write!(f, "{reason}"),
            Self::IgnoredOnLine { line, reason } => write!(f, "serial line {line}: ignored: {reason}"),
        }
    }
}

/// A running gateway for one serial line; it ends when dropped.
#[derive(Debug)]
pub struct Gateway {
    is_stopping: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Gateway {
    /// Starts to connect the device at the other end of `line` with the broker that `reach` names. The
    /// device must belong to
    /// `site`. `say` receives the events.
    pub fn start(
        site: SiteId,
        reach: Reach,
        line: SerialConfig,
        say: impl Fn(GatewayEvent) + Send + 'static,
    ) -> Self {
        let is_stopping = Arc::new(AtomicBool::new(false));
        let stop = Arc::clone(&is_stopping);
        let thread = std::thread::spawn(move || {
            let name = line.name.clone();
            let line = SerialTransport::start(line);
            let mut bridge = Bridge {
                name,
                reach,
                line,
                client: None,
                relay: Relay::new(site),
                up: None,
                newborn: None,
                births: Pace::new(1, BIRTHS_EVERY),
                wants: Pace::new(WANTS_MAX, WANTS_EVERY),
                quiet: Quiet::default(),
                begun: Instant::now(),
                say,
            };
            while !stop.load(Ordering::Relaxed) {
                bridge.up();
                bridge.start_newborn();
                bridge.down();
            }
        });
        Self { is_stopping, thread: Some(thread) }
    }
}

impl Drop for Gateway {
    fn drop(&mut self) {
        self.is_stopping.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A panic of the thread has been printed already.
            let _ = thread.join();
        }
    }
}

/// Both sides of the gateway: the line, and the client at the broker.
struct Bridge<F> {
    name: String,
    reach: Reach,
    line: SerialTransport,
    /// The client at the broker, in the device's name.
    client: Option<MqttTransport>,
    relay: Relay,
    /// A message of the device that waits for room at the broker. Until it is sent, nothing is read from the
    /// line.
    up: Option<Outgoing>,
    /// A session of the device whose client is not started yet, with its last will.
    newborn: Option<(Identity, Option<Outgoing>)>,
    births: Pace,
    wants: Pace,
    quiet: Quiet,
    /// The moment from which time is counted.
    begun: Instant,
    say: F,
}

impl<F: Fn(GatewayEvent)> Bridge<F> {
    /// Moves at most one message from the device to the broker.
    fn up(&mut self) {
        if let (Some(message), Some(client)) = (self.up.take(), &mut self.client)
            && client.publish(&message) == Err(PublishError::Busy)
        {
            self.up = Some(message);
            return;
        }
        if let Some((_, more)) = self.quiet.summary(self.begun.elapsed()) {
            let reason = format!("{more} more messages like these");
            (self.say)(GatewayEvent::IgnoredOnLine { line: self.name.clone(), reason });
        }
        // What the device says next is for the client that is not started yet.
        if self.newborn.is_some() {
            return std::thread::sleep(LISTEN);
        }
        match self.line.poll(LISTEN) {
            Some(TransportEvent::Incoming { topic, payload }) => self.pass(&topic, payload),
            Some(TransportEvent::Disconnected { reason, .. }) => {
                (self.client, self.newborn) = (None, None);
                self.tell(GatewayEvent::OffLine { reason });
            }
            Some(
                TransportEvent::Connected | TransportEvent::Resumed { .. } | TransportEvent::Denied { .. },
            )
            | None => {}
        }
    }

    fn pass(&mut self, topic: &str, payload: Vec<u8>) {
        match self.relay.hear_device(topic, payload) {
            Passage::Born(identity, will) => {
                self.client = None;
                self.newborn = Some((identity, will));
            }
            Passage::Want(message) if self.wants.allows(self.begun.elapsed()) => self.up = Some(message),
            Passage::Want(_) => {
                self.refuse("the device asks for chunks too often".to_owned());
            }
            Passage::Pass(message) => self.up = Some(message),
            Passage::Refuse(reason) => self.refuse(reason),
        }
    }

    /// Starts the client of a session that has begun, unless the last one was started just before.
    fn start_newborn(&mut self) {
        let now = self.begun.elapsed();
        let Some((identity, will)) = self.newborn.take_if(|_| self.births.allows(now)) else { return };
        match self.reach.config_of_line(identity, will) {
            Ok(config) => {
                self.client = Some(MqttTransport::start(config));
                self.tell(GatewayEvent::OnLine { line: self.name.clone(), device: identity.device });
            }
            Err(error) => self.refuse(format!("line_certs: {error}")),
        }
    }

    fn refuse(&mut self, reason: String) {
        self.tell(GatewayEvent::IgnoredOnLine { line: self.name.clone(), reason });
    }

    /// Reports an event, unless the line causes too many.
    fn tell(&mut self, event: GatewayEvent) {
        if self.quiet.notes(self.begun.elapsed(), None) {
            (self.say)(event);
        }
    }

    /// Moves messages from the broker to the device.
    fn down(&mut self) {
        let Some(client) = &mut self.client else { return };
        let mut denied = Vec::new();
        while let Some(event) = client.poll(Duration::ZERO) {
            match event {
                TransportEvent::Incoming { topic, payload } => self.relay.hear_broker(&topic, payload),
                // The client is new, or the broker may have lost the device's birth notice: publish the
                // notice.
                TransportEvent::Connected | TransportEvent::Resumed { .. } => {
                    self.up = self.up.take().or_else(|| self.relay.birth());
                }
                TransportEvent::Denied { reason } => denied.push(reason),
                TransportEvent::Disconnected { .. } => {}
            }
        }
        denied.into_iter().for_each(|reason| self.refuse(reason));
        while let Some(message) = self.relay.next_down()
            && self.line.publish(message) != Err(PublishError::Busy)
        {
            self.relay.passed_down();
        }
    }
}
