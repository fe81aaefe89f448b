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

mod relay;

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use cosurf_link::{
    MqttTransport, Outgoing, PublishError, SerialConfig, SerialTransport, Transport, TransportEvent,
};
use cosurf_wire::{DeviceId, SiteId};
use serde::Serialize;

use crate::broker::Reach;
use relay::{Passage, Relay};

/// Longest wait for a message from the serial line before the messages of the broker have their turn.
const LISTEN: Duration = Duration::from_millis(10);

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
            let mut bridge =
                Bridge { name, reach, line, client: None, relay: Relay::new(site), up: None, say };
            while !stop.load(Ordering::Relaxed) {
                bridge.up();
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
        match self.line.poll(LISTEN) {
            Some(TransportEvent::Incoming { topic, payload }) => self.pass(&topic, payload),
            Some(TransportEvent::Disconnected { reason, .. }) => {
                self.client = None;
                (self.say)(GatewayEvent::OffLine { reason });
            }
            Some(TransportEvent::Connected) | None => {}
        }
    }

    fn pass(&mut self, topic: &str, payload: Vec<u8>) {
        match self.relay.hear_device(topic, payload) {
            Passage::Born(identity, will) => match self.reach.config_of_line(identity, will) {
                Ok(config) => {
                    self.client = Some(MqttTransport::start(config));
                    (self.say)(GatewayEvent::OnLine { line: self.name.clone(), device: identity.device });
                }
                Err(error) => {
                    let (line, reason) = (self.name.clone(), format!("line_certs: {error}"));
                    (self.say)(GatewayEvent::IgnoredOnLine { line, reason });
                }
            },
            Passage::Pass(message) => self.up = Some(message),
            Passage::Refuse(reason) => {
                (self.say)(GatewayEvent::IgnoredOnLine { line: self.name.clone(), reason });
            }
        }
    }

    /// Moves messages from the broker to the device.
    fn down(&mut self) {
        let Some(client) = &mut self.client else { return };
        while let Some(event) = client.poll(Duration::ZERO) {
            match event {
                TransportEvent::Incoming { topic, payload } => self.relay.hear_broker(&topic, payload),
                // The client is new, or the broker may have lost the device's birth notice: publish the
                // notice.
                TransportEvent::Connected => self.up = self.up.take().or_else(|| self.relay.birth()),
                TransportEvent::Disconnected { .. } => {}
            }
        }
        while let Some(message) = self.relay.next_down()
            && self.line.publish(message) != Err(PublishError::Busy)
        {
            self.relay.passed_down();
        }
    }
}
