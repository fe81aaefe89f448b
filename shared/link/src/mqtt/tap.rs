//! Listens to all that is said on a broker, and says it again: [`record`] and [`replay`].

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
use super::tls::Tls;
use super::worker::{PACKET_BYTES_MAX, describe};
use crate::faults::{Faults, Line};
use crate::recording::{Entry, Recorder, Recording, RecordingError};

/// Messages that wait for the connection.
const QUEUE_MAX: usize = 64;
/// How often the wish to stop is looked at, and what was recorded is handed to the disk.
const LOOK_UP: Duration = Duration::from_millis(200);
/// Between attempts to connect.
const PAUSE: Duration = Duration::from_millis(500);
/// Attempts to reach a broker that was never reached.
const ATTEMPTS_MAX: u32 = 8;
/// What was published last gets this long to be acknowledged.
const FAREWELL: Duration = Duration::from_secs(30);

/// Why listening or saying again ended.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TapError {
    /// The recording.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// The file cannot be written.
    #[error("the recording cannot be written: {0}")]
    Write(#[source] io::Error),
    /// The broker cannot be reached, or was lost for good.
    #[error("broker {broker}: {reason}; gave up after {ATTEMPTS_MAX} attempts")]
    NoBroker {
        /// Where.
        broker: String,
        /// What it said last.
        reason: String,
    },
}

/// How to say it again.
#[derive(Clone, Copy, Debug)]
pub struct ReplaySettings {
    /// So many times as fast as it was; `None` for as fast as the broker takes it.
    pub speed: Option<f64>,
    /// What goes wrong on the way.
    pub faults: Faults,
    /// Of what goes wrong.
    pub seed: u64,
}

/// Writes all that is published under `filter` to `out` until told to stop; returns how many messages.
pub fn record(
    broker: &BrokerAddress,
    tls: Option<&Tls>,
    filter: &str,
    out: impl Write,
    is_stopping: &AtomicBool,
) -> Result<u64, TapError> {
    let mut recorder = Recorder::new(out).map_err(TapError::Write)?;
    let (client, mut connection) = Client::new(options(broker, tls, "record"), QUEUE_MAX);
    let (begun, mut count, mut attempt) = (Instant::now(), 0, 0);
    let mut flushed = begun;
    while !is_stopping.load(Ordering::Relaxed) {
        match connection.recv_timeout(LOOK_UP) {
            Ok(Ok(Event::Incoming(Packet::ConnAck(_)))) => {
                let filter = Filter {
                    path: filter.to_owned(),
                    qos: QoS::AtLeastOnce,
                    preserve_retain: true,
                    ..Filter::default()
                };
                // The queue is empty after a connection, so there is room.
                let _ = client.try_subscribe_many([filter]);
                attempt = 0;
            }
            Ok(Ok(Event::Incoming(Packet::Publish(publish)))) => {
                let entry = entry(begun.elapsed(), &publish);
                count += u64::from(recorder.add(&entry).map_err(TapError::Write)?);
            }
            Ok(Err(error)) => {
                attempt += 1;
                if attempt >= ATTEMPTS_MAX {
                    return Err(lost(broker, describe(&error)));
                }
                sleep(PAUSE);
            }
            Ok(Ok(_)) | Err(_) => {}
        }
        if flushed.elapsed() >= LOOK_UP {
            recorder.flush().map_err(TapError::Write)?;
            flushed = Instant::now();
        }
    }
    recorder.flush().map_err(TapError::Write)?;
    Ok(count)
}

/// Publishes a recording again until its end, or until told to stop; returns how many messages were
/// published and acknowledged.
pub fn replay(
    broker: &BrokerAddress,
    tls: Option<&Tls>,
    recording: Recording<impl Read>,
    settings: &ReplaySettings,
    is_stopping: &AtomicBool,
) -> Result<u64, TapError> {
    let (client, connection) = Client::new(options(broker, tls, "replay"), QUEUE_MAX);
    let driver = Driver::start(connection);
    driver.wait(Duration::MAX, is_stopping, |state| state.is_connected.load(Ordering::Relaxed));
    let (begun, mut sent) = (Instant::now(), 0);
    let mut player = Player::new(recording, settings);
    while let Some(Entry { at, topic, retain, payload, .. }) = player.next_entry()? {
        let at = settings.speed.map_or(Duration::ZERO, |speed| at.div_f64(speed));
        while begun.elapsed() < at && !driver.is_over(is_stopping) {
            sleep(LOOK_UP.min(at.saturating_sub(begun.elapsed())));
        }
        if driver.is_over(is_stopping) {
            break;
        }
        // Fails only where the driver has ended, which is seen next.
        if client.publish(topic, QoS::AtLeastOnce, retain, payload).is_ok() {
            sent += 1;
        }
    }
    driver.wait(FAREWELL, is_stopping, |state| state.acknowledged.load(Ordering::Relaxed) >= sent);
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

fn options(broker: &BrokerAddress, tls: Option<&Tls>, role: &str) -> MqttOptions {
    let client_id = format!("cosurf-{role}-{}", std::process::id());
    let mut options = MqttOptions::new(client_id, broker.socket_host(), broker.port);
    options.set_clean_start(true).set_max_packet_size(Some(PACKET_BYTES_MAX as u32));
    if let Some(tls) = tls {
        options.set_transport(TlsTransport::tls_with_config(TlsConfiguration::Rustls(Arc::clone(&tls.0))));
    }
    options
}

fn lost(broker: &BrokerAddress, reason: String) -> TapError {
    TapError::NoBroker { broker: broker.to_string(), reason }
}

/// A recording with faults: its entries in the order in which they are said again.
struct Player<R> {
    recording: Recording<R>,
    line: Line,
    waiting: BTreeMap<(Duration, u64), Entry>,
    copies: u64,
    /// How far the recording was read; `None` at its end.
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

/// The thread that drives a publishing connection.
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
                        sleep(PAUSE);
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

    fn wait(&self, longest: Duration, is_stopping: &AtomicBool, is_done: impl Fn(&DriverState) -> bool) {
        let begun = Instant::now();
        while !is_done(&self.state) && !self.is_over(is_stopping) && begun.elapsed() < longest {
            sleep(Duration::from_millis(5));
        }
    }

    fn end(self, broker: &BrokerAddress) -> Result<u64, TapError> {
        match self.thread.join() {
            Ok(Some(reason)) => Err(lost(broker, reason)),
            _ => Ok(self.state.acknowledged.load(Ordering::Relaxed)),
        }
    }
}
