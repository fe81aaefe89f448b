//! Records the messages of a broker with [`record`], and publishes a recording again with [`replay`].

use std::collections::BTreeMap;
use std::io::{self, Read, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::{JoinHandle, sleep};
use std::time::{Duration, Instant};

use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{Filter, Packet, Publish};
use rumqttc::v5::{Client, Connection, Event, MqttOptions};
use rumqttc::{TlsConfiguration, Transport as TlsTransport};

use super::address::BrokerAddress;
use super::config::Login;
use super::tls::Tls;
use super::worker::{PACKET_BYTES_MAX, describe};
use crate::faults::{Faults, Line};
use crate::recording::{Entry, Recorder, Recording, RecordingError};

/// Maximum number of messages queued for the connection.
const QUEUE_MAX: usize = 64;
/// Interval at which a request to stop is checked, and at which the recording is flushed.
const TICK: Duration = Duration::from_millis(200);
/// Delay between attempts to connect.
const RECONNECT_DELAY: Duration = Duration::from_millis(500);
/// Number of consecutive failed attempts to connect after which recording or replaying fails.
const ATTEMPTS_MAX: u32 = 8;
/// How long the end of a replay waits for the last acknowledgements.
const ACKNOWLEDGEMENT_TIMEOUT: Duration = Duration::from_secs(30);

/// Why recording or replaying failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TrafficError {
    /// The recording is invalid.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// The recording cannot be written.
    #[error("the recording cannot be written: {0}")]
    Write(#[source] io::Error),
    /// The broker could not be reached in [`ATTEMPTS_MAX`] consecutive attempts, at the start or after a lost
    /// connection.
    #[error("broker {broker}: {reason}; gave up after {ATTEMPTS_MAX} attempts")]
    NoBroker {
        /// The broker's address.
        broker: String,
        /// The last error.
        reason: String,
    },
}

/// Settings of a replay.
#[derive(Clone, Copy, Debug)]
pub struct ReplaySettings {
    /// Playback speed relative to the recording; `None` publishes as fast as the broker accepts.
    pub speed: Option<f64>,
    /// Faults to inject into the recording. [`Faults::outages`] has no effect.
    pub faults: Faults,
    /// Seed of the faults.
    pub seed: u64,
}

/// Records all messages whose topics match `filter`, until `is_stopping` is set. Returns the number of
/// recorded messages. Messages that are too large are skipped.
pub fn record(
    broker: &BrokerAddress,
    tls: Option<&Tls>,
    login: Option<&Login>,
    filter: &str,
    out: impl Write,
    is_stopping: &AtomicBool,
) -> Result<u64, TrafficError> {
    let mut recorder = Recorder::new(out).map_err(TrafficError::Write)?;
    let (client, mut connection) = Client::new(options(broker, tls, login, "record"), QUEUE_MAX);
    let (start, mut count, mut attempt) = (Instant::now(), 0, 0);
    let mut flushed_at = start;
    while !is_stopping.load(Ordering::Relaxed) {
        match connection.recv_timeout(TICK) {
            Ok(Ok(Event::Incoming(Packet::ConnAck(_)))) => {
                let filter = Filter {
                    path: filter.to_owned(),
                    qos: QoS::AtLeastOnce,
                    preserve_retain: true,
                    ..Filter::default()
                };
                // Cannot fail: the queue is empty, because nothing else is sent on this connection.
                let _ = client.try_subscribe_many([filter]);
                attempt = 0;
            }
            Ok(Ok(Event::Incoming(Packet::Publish(publish)))) => {
                let entry = entry(start.elapsed(), &publish);
                count += u64::from(recorder.add(&entry).map_err(TrafficError::Write)?);
            }
            Ok(Err(error)) => {
                attempt += 1;
                if attempt >= ATTEMPTS_MAX {
                    return Err(no_broker(broker, describe(&error)));
                }
                sleep(RECONNECT_DELAY);
            }
            Ok(Ok(_)) | Err(_) => {}
        }
        if flushed_at.elapsed() >= TICK {
            recorder.flush().map_err(TrafficError::Write)?;
            flushed_at = Instant::now();
        }
    }
    recorder.flush().map_err(TrafficError::Write)?;
    Ok(count)
}

/// Publishes a recording to its end, or until `is_stopping` is set. Returns the number of messages that the
/// broker acknowledged.
pub fn replay(
    broker: &BrokerAddress,
    tls: Option<&Tls>,
    login: Option<&Login>,
    recording: Recording<impl Read>,
    settings: &ReplaySettings,
    is_stopping: &AtomicBool,
) -> Result<u64, TrafficError> {
    let (client, connection) = Client::new(options(broker, tls, login, "replay"), QUEUE_MAX);
    let driver = Driver::start(connection);
    driver.wait_until(Duration::MAX, is_stopping, |state| state.is_connected.load(Ordering::Relaxed));
    let (start, mut sent) = (Instant::now(), 0);
    let mut player = Player::new(recording, settings);
    while let Some(Entry { at, topic, retain, payload, .. }) = player.next_entry()? {
        let at = settings.speed.map_or(Duration::ZERO, |speed| at.div_f64(speed));
        while start.elapsed() < at && !driver.is_over(is_stopping) {
            sleep(TICK.min(at.saturating_sub(start.elapsed())));
        }
        if driver.is_over(is_stopping) {
            break;
        }
        // Publishing fails only after the driver has ended. The next iteration checks that.
        if client.publish(topic, QoS::AtLeastOnce, retain, payload).is_ok() {
            sent += 1;
        }
    }
    driver.wait_until(ACKNOWLEDGEMENT_TIMEOUT, is_stopping, |state| {
        state.acknowledged.load(Ordering::Relaxed) >= sent
    });
    let _ = client.disconnect();
    driver.end(broker)
}

fn entry(at: Duration, publish: &Publish) -> Entry {
    Entry {
        at,
        topic: String::from_utf8_lossy(&publish.topic).into_owned(),
        qos: publish.qos as u8,
        retain: publish.retain,
        payload: publish.payload.to_vec(),
    }
}

fn options(broker: &BrokerAddress, tls: Option<&Tls>, login: Option<&Login>, role: &str) -> MqttOptions {
    let client_id = format!("cosurf-{role}-{}", std::process::id());
    let mut options = MqttOptions::new(client_id, broker.socket_host(), broker.port);
    options.set_clean_start(true).set_max_packet_size(Some(PACKET_BYTES_MAX as u32));
    if let Some(Login { user, password }) = login {
        options.set_credentials(user, password);
    }
    if let Some(tls) = tls {
        options.set_transport(TlsTransport::tls_with_config(TlsConfiguration::Rustls(Arc::clone(&tls.0))));
    }
    options
}

fn no_broker(broker: &BrokerAddress, reason: String) -> TrafficError {
    TrafficError::NoBroker { broker: broker.to_string(), reason }
}

/// Injects faults into a recording, and returns the entries in the order in which they are replayed.
struct Player<R> {
    recording: Recording<R>,
    line: Line,
    waiting: BTreeMap<(Duration, u64), Entry>,
    copies: u64,
    /// Time in the recording of the last entry read; `None` at the end of the recording.
    read_to: Option<Duration>,
}

impl<R: Read> Player<R> {
    fn new(recording: Recording<R>, settings: &ReplaySettings) -> Self {
        let line = Line::new(settings.seed, settings.faults);
        Self { recording, line, waiting: BTreeMap::new(), copies: 0, read_to: Some(Duration::ZERO) }
    }

    fn next_entry(&mut self) -> Result<Option<Entry>, RecordingError> {
        while let Some(read_to) = self.read_to {
            if self.waiting.first_key_value().is_some_and(|((at, _), _)| *at < read_to) {
                break;
            }
            let entry = self.recording.next_entry()?;
            self.read_to = entry.as_ref().map(|entry| entry.at);
            let Some(entry) = entry else { break };
            for arrival in self.line.carry(entry.at, &entry.payload) {
                self.copies += 1;
                let copy = Entry { at: arrival.at, payload: arrival.bytes, ..entry.clone() };
                self.waiting.insert((copy.at, self.copies), copy);
            }
        }
        Ok(self.waiting.pop_first().map(|(_, entry)| entry))
    }
}

/// The thread that runs the event loop of a publishing connection.
struct Driver {
    state: Arc<DriverState>,
    thread: JoinHandle<Option<String>>,
}

#[derive(Default)]
struct DriverState {
    is_connected: AtomicBool,
    acknowledged: AtomicU64,
}

impl Driver {
    fn start(mut connection: Connection) -> Self {
        let state = Arc::new(DriverState::default());
        let shared = Arc::clone(&state);
        let thread = std::thread::spawn(move || {
            let mut attempt = 0;
            for event in connection.iter() {
                match event {
                    Ok(Event::Incoming(Packet::ConnAck(_))) => {
                        attempt = 0;
                        shared.is_connected.store(true, Ordering::Relaxed);
                    }
                    Ok(Event::Incoming(Packet::PubAck(_))) => {
                        shared.acknowledged.fetch_add(1, Ordering::Relaxed);
                    }
                    Ok(Event::Outgoing(rumqttc::Outgoing::Disconnect)) => return None,
                    Ok(_) => {}
                    Err(error) => {
                        attempt += 1;
                        if attempt >= ATTEMPTS_MAX {
                            return Some(describe(&error));
                        }
                        sleep(RECONNECT_DELAY);
                    }
                }
            }
            None
        });
        Self { state, thread }
    }

    fn is_over(&self, is_stopping: &AtomicBool) -> bool {
        self.thread.is_finished() || is_stopping.load(Ordering::Relaxed)
    }

    fn wait_until(
        &self,
        timeout: Duration,
        is_stopping: &AtomicBool,
        is_done: impl Fn(&DriverState) -> bool,
    ) {
        let start = Instant::now();
        while !is_done(&self.state) && !self.is_over(is_stopping) && start.elapsed() < timeout {
            sleep(Duration::from_millis(5));
        }
    }

    fn end(self, broker: &BrokerAddress) -> Result<u64, TrafficError> {
        match self.thread.join() {
            Ok(Some(reason)) => Err(no_broker(broker, reason)),
            _ => Ok(self.state.acknowledged.load(Ordering::Relaxed)),
        }
    }
}
