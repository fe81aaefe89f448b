//! Records the messages of a broker with [`record`], and publishes a recording again with [`replay`].

use std::collections::BTreeMap;
use std::io::{self, Read, Write};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::Filter;

use super::address::BrokerAddress;
use super::client::Client;
use super::settings::{ClientSettings, Login, RECEIVE_MAX};
use super::shared::ClientEvent;
use super::tls::Tls;
use crate::faults::{Faults, Line};
use crate::recording::{Entry, Lost, Recorder, Recording, RecordingError};
use crate::transport::PublishError;

/// Interval at which a request to stop is checked, and at which the recording is flushed.
const TICK: Duration = Duration::from_millis(200);
/// Interval at which a replay looks whether there is room for the next message.
const ROOM_TICK: Duration = Duration::from_millis(2);
/// Number of consecutive failed attempts to connect after which a replay fails, or a recording that was never connected.
const ATTEMPTS_MAX: u32 = 6;
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
    /// The broker could not be reached in [`ATTEMPTS_MAX`] consecutive attempts: at the start or, in a replay, after a lost
    /// connection.
    #[error("{reason}; gave up after {ATTEMPTS_MAX} attempts")]
    NoBroker {
        /// The broker's address and the last error.
        reason: String,
    },
}

/// What a recording tells of its connection.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ConnectionNews {
    /// There is no connection yet. The recording tries again a few times.
    NotYet {
        /// The broker's address and the error.
        reason: String,
    },
    /// The connection was lost, or there is another reason why it is not back. The recording tries again without end.
    Lost {
        /// The broker's address and the error.
        reason: String,
    },
    /// The connection is back. Messages of the time between are not recorded.
    Back,
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
/// recorded messages. Messages that are too large are skipped. Once it was connected, it outlasts every loss of the
/// connection, which it tells.
pub fn record(
    broker: &BrokerAddress,
    tls: Option<&Tls>,
    login: Option<&Login>,
    filter: &str,
    out: impl Write,
    is_stopping: &AtomicBool,
    mut tell: impl FnMut(ConnectionNews),
) -> Result<u64, TrafficError> {
    let mut recorder = Recorder::new(out).map_err(TrafficError::Write)?;
    let filter =
        Filter { path: filter.to_owned(), qos: QoS::AtLeastOnce, preserve_retain: true, ..Filter::default() };
    let client = Client::start(settings(broker, tls, login, "record", vec![filter]));
    let (start, mut count) = (Instant::now(), 0);
    let (mut flushed_at, mut connection) = (start, Connection::Never(None));
    while !is_stopping.load(Ordering::Relaxed) {
        if let Some(event) = client.poll(TICK) {
            connection.follow(&event).into_iter().for_each(&mut tell);
            let is_new = matches!(connection, Connection::Never(_));
            if let Some(entry) = entry(event, start.elapsed(), is_new)? {
                count += u64::from(recorder.add(&entry).map_err(TrafficError::Write)?);
            }
        }
        if flushed_at.elapsed() >= TICK {
            recorder.flush().map_err(TrafficError::Write)?;
            flushed_at = Instant::now();
        }
    }
    recorder.flush().map_err(TrafficError::Write)?;
    Ok(count)
}

/// Publishes a recording to its end, or until `is_stopping` is set. Returns the number of messages that the broker
/// acknowledged, and what was passed over in the recording.
pub fn replay(
    broker: &BrokerAddress,
    tls: Option<&Tls>,
    login: Option<&Login>,
    recording: Recording<impl Read>,
    faults: &ReplaySettings,
    is_stopping: &AtomicBool,
) -> Result<(u64, Lost), TrafficError> {
    let client = Client::start(settings(broker, tls, login, "replay", Vec::new()));
    let mut session = Replay { client, is_stopping, is_connected: false };
    session.wait_until(Duration::MAX, TICK, |session| session.is_connected)?;
    let start = Instant::now();
    let mut player = Player::new(recording, faults);
    while let Some(entry) = player.next_entry()? {
        let at = faults.speed.map_or(Duration::ZERO, |speed| entry.at.div_f64(speed));
        while start.elapsed() < at && !session.is_over() {
            session.listen(TICK.min(at.saturating_sub(start.elapsed())))?;
        }
        session.publish(&entry)?;
        if session.is_over() {
            break;
        }
    }
    session.wait_until(ACKNOWLEDGEMENT_TIMEOUT, ROOM_TICK, |session| session.client.pending() == 0)?;
    Ok((session.client.acknowledged() as u64, player.recording.lost()))
}

/// The connection of a recording.
#[derive(Debug, PartialEq, Eq)]
enum Connection {
    /// There was none yet, for the reason that was told last, if any was.
    Never(Option<String>),
    Up,
    /// It is lost, for the reason that was told last.
    Lost(String),
}

impl Connection {
    /// Notes an event. Returns what is to be told: of attempts that fail alike, only the first.
    fn follow(&mut self, event: &ClientEvent) -> Option<ConnectionNews> {
        match (&*self, event) {
            (Self::Never(_), ClientEvent::Connected | ClientEvent::Resumed { .. }) => {
                *self = Self::Up;
                None
            }
            (Self::Lost(_), ClientEvent::Connected | ClientEvent::Resumed { .. }) => {
                *self = Self::Up;
                Some(ConnectionNews::Back)
            }
            (Self::Never(told), ClientEvent::Disconnected { reason, .. })
                if told.as_ref() != Some(reason) =>
            {
                *self = Self::Never(Some(reason.clone()));
                Some(ConnectionNews::NotYet { reason: reason.clone() })
            }
            (Self::Never(_), _) => None,
            (Self::Lost(told), ClientEvent::Disconnected { reason, .. }) if told == reason => None,
            (_, ClientEvent::Disconnected { reason, .. }) => {
                *self = Self::Lost(reason.clone());
                Some(ConnectionNews::Lost { reason: reason.clone() })
            }
            _ => None,
        }
    }
}

/// The entry of the recording for an event; `None` if the event is no message. An error if the broker cannot be reached
/// and the caller `gives_up`.
fn entry(event: ClientEvent, at: Duration, gives_up: bool) -> Result<Option<Entry>, TrafficError> {
    match event {
        ClientEvent::Connected | ClientEvent::Resumed { .. } | ClientEvent::Denied { .. } => Ok(None),
        ClientEvent::Message { topic, payload, qos, retain } => {
            Ok(Some(Entry { at, topic, qos: qos as u8, retain, payload }))
        }
        ClientEvent::Disconnected { attempt, reason } if gives_up && attempt >= ATTEMPTS_MAX => {
            Err(TrafficError::NoBroker { reason })
        }
        ClientEvent::Disconnected { .. } => Ok(None),
    }
}

fn settings(
    broker: &BrokerAddress,
    tls: Option<&Tls>,
    login: Option<&Login>,
    role: &str,
    filters: Vec<Filter>,
) -> ClientSettings {
    ClientSettings {
        broker: broker.clone(),
        tls: tls.cloned(),
        login: login.cloned(),
        client_id: format!("cosurf-{role}-{}", std::process::id()),
        session_expiry_s: 0,
        receive_max: RECEIVE_MAX,
        will: None,
        filters,
    }
}

/// A replay that goes on.
struct Replay<'a> {
    client: Client,
    is_stopping: &'a AtomicBool,
    is_connected: bool,
}

impl Replay<'_> {
    fn is_over(&self) -> bool {
        self.is_stopping.load(Ordering::Relaxed)
    }

    /// Waits for this time. An error if the broker cannot be reached.
    fn listen(&mut self, time: Duration) -> Result<(), TrafficError> {
        let Some(event) = self.client.poll(time) else { return Ok(()) };
        self.is_connected |= matches!(event, ClientEvent::Connected | ClientEvent::Resumed { .. });
        entry(event, Duration::ZERO, true).map(drop)
    }

    fn wait_until(
        &mut self,
        timeout: Duration,
        tick: Duration,
        is_done: impl Fn(&Self) -> bool,
    ) -> Result<(), TrafficError> {
        let start = Instant::now();
        while !is_done(self) && !self.is_over() && start.elapsed() < timeout {
            self.listen(tick)?;
        }
        Ok(())
    }

    /// Publishes an entry, as soon as there is room. Entries above the broker's limit are skipped.
    fn publish(&mut self, entry: &Entry) -> Result<(), TrafficError> {
        while !self.is_over()
            && self.client.publish(&entry.topic, &entry.payload, entry.retain) == Err(PublishError::Busy)
        {
            self.listen(ROOM_TICK)?;
        }
        Ok(())
    }
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
