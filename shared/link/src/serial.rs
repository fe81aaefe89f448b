//! A serial line, such as a telemetry radio (SiK), between one device and a gateway: the conversation's
//! messages over [`Arq`], on a thread of its own.
//!
//! A line that is cut goes on where it was when it stands again; a device or gateway that starts anew is
//! told apart by its session, and the chunks that are missing then are asked for by the conversation
//! above. Clocks are read here to keep the line's pace.

mod arq;
mod letter;
mod receiving;
mod sending;

use std::io::{self, Read, Write};
use std::num::NonZeroU32;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use cosurf_wire::frame::FrameReader;

pub use arq::{Arq, ArqEvent};

use crate::pacing::Backoff;
use crate::transport::{Outgoing, PublishError, Transport, TransportEvent};

/// The usual speed of telemetry radios.
pub const DEFAULT_BAUD: NonZeroU32 = NonZeroU32::new(57_600).expect("not zero");
/// Largest message that a device sends: three seconds of a radio.
pub const DEVICE_MESSAGE_BYTES: usize = 16 * 1024;
/// Largest message that a gateway sends: any.
pub const GATEWAY_MESSAGE_BYTES: usize = letter::MAX_LETTER_BYTES - 1;

/// Longest that the port is listened to before the time is looked at.
const LISTEN: Duration = Duration::from_millis(10);
/// A port that takes nothing for so long is broken.
const WRITE_TIMEOUT: Duration = Duration::from_secs(5);
/// Between attempts to open the port.
const REOPEN: Backoff = Backoff::new(Duration::from_millis(200), Duration::from_secs(5));
/// Bits on the line for a byte: start, eight of data, stop.
const BITS_PER_BYTE: u32 = 10;
/// Messages that wait for the owner; then the line holds the other side back.
const EVENTS_MAX: usize = 16;

/// What bytes go through: a serial port, or anything else of that kind. Reading must return after some
/// milliseconds with [`io::ErrorKind::TimedOut`] where there is nothing.
pub trait Port: Read + Write + Send {}

impl<T: Read + Write + Send> Port for T {}

/// Opens a port, again and again where it is lost.
pub type OpenPort = Box<dyn FnMut() -> io::Result<Box<dyn Port>> + Send>;

/// A line, by name.
pub struct SerialConfig {
    /// What messages call it, `/dev/ttyUSB0`.
    pub name: String,
    /// What it takes.
    pub bytes_per_s: NonZeroU32,
    /// Number of this side's session, unlike the one before.
    pub session: u64,
    /// Largest message that this side sends.
    pub message_bytes_max: usize,
    /// How to open it.
    pub open: OpenPort,
}

impl SerialConfig {
    /// A serial port of this machine.
    pub fn device(path: &str, baud: NonZeroU32, session: u64, message_bytes_max: usize) -> Self {
        let builder = serialport::new(path, baud.get()).timeout(LISTEN);
        Self {
            name: path.to_owned(),
            bytes_per_s: NonZeroU32::new(baud.get() / BITS_PER_BYTE).unwrap_or(NonZeroU32::MIN),
            session,
            message_bytes_max,
            open: Box::new(move || Ok(Box::new(builder.clone().open().map_err(io::Error::from)?))),
        }
    }
}

/// One end of a serial line. Dropping it leaves unsent what has not gone out.
pub struct SerialTransport {
    arq: Arc<Mutex<Arq>>,
    message_bytes_max: usize,
    is_stopping: Arc<AtomicBool>,
    events: Receiver<TransportEvent>,
    thread: Option<JoinHandle<()>>,
}

impl SerialTransport {
    /// Starts to listen; success and failure come as events.
    pub fn start(config: SerialConfig) -> Self {
        // Sessions are counted from day to day; the line's own numbers only tell neighbours apart.
        let arq = Arc::new(Mutex::new(Arq::new(config.session as u32, config.bytes_per_s)));
        let is_stopping = Arc::new(AtomicBool::new(false));
        let (sender, events) = sync_channel(EVENTS_MAX);
        let message_bytes_max = config.message_bytes_max;
        let worker = Worker {
            name: config.name,
            open: config.open,
            arq: Arc::clone(&arq),
            is_stopping: Arc::clone(&is_stopping),
            events: sender,
            held: None,
            begun: Instant::now(),
            reader: FrameReader::default(),
            attempt: 0,
        };
        let thread = std::thread::spawn(move || worker.run());
        Self { arq, message_bytes_max, is_stopping, events, thread: Some(thread) }
    }
}

impl Transport for SerialTransport {
    fn publish(&mut self, message: &Outgoing) -> Result<(), PublishError> {
        let bytes = message.topic.len() + message.payload.len();
        if bytes > self.message_bytes_max {
            return Err(PublishError::TooLarge { bytes, max_bytes: self.message_bytes_max });
        }
        let mut arq = lock(&self.arq);
        if !arq.has_room() {
            return Err(PublishError::Busy);
        }
        arq.queue(letter::seal(&message.topic, &message.payload));
        Ok(())
    }

    fn poll(&mut self, timeout: Duration) -> Option<TransportEvent> {
        self.events.recv_timeout(timeout).ok()
    }
}

impl Drop for SerialTransport {
    fn drop(&mut self) {
        self.is_stopping.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A panic there has been printed; there is nothing to add.
            let _ = thread.join();
        }
    }
}

fn lock(arq: &Mutex<Arq>) -> MutexGuard<'_, Arq> {
    arq.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The thread that holds the port.
struct Worker {
    name: String,
    open: OpenPort,
    arq: Arc<Mutex<Arq>>,
    is_stopping: Arc<AtomicBool>,
    events: SyncSender<TransportEvent>,
    /// For the owner, as soon as it has room.
    held: Option<TransportEvent>,
    begun: Instant,
    reader: FrameReader,
    attempt: u32,
}

impl Worker {
    fn run(mut self) {
        let mut reopen = REOPEN;
        while !self.is_stopping() {
            let error = match (self.open)() {
                Ok(mut port) => match self.drive(port.as_mut(), &mut reopen) {
                    Ok(()) => return,
                    Err(error) => error,
                },
                Err(error) => error,
            };
            self.fail(&error.to_string());
            let until = Instant::now() + reopen.delay();
            while Instant::now() < until && !self.is_stopping() {
                self.hand_over();
                std::thread::sleep(LISTEN);
            }
        }
    }

    /// Speaks and listens until the owner wishes to stop.
    fn drive(&mut self, port: &mut dyn Port, reopen: &mut Backoff) -> io::Result<()> {
        let mut buffer = [0; 1024];
        while !self.is_stopping() {
            self.speak(port)?;
            self.hand_over();
            match port.read(&mut buffer) {
                Ok(0) => return Err(io::ErrorKind::UnexpectedEof.into()),
                Ok(read) => {
                    reopen.reset();
                    self.listen(&buffer[..read]);
                }
                Err(error) if is_passing(&error) => {}
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }

    fn speak(&self, port: &mut dyn Port) -> io::Result<()> {
        let mut arq = lock(&self.arq);
        while let Some(frame) = arq.next_frame(self.begun.elapsed()) {
            write_all(port, frame)?;
        }
        Ok(())
    }

    fn listen(&mut self, bytes: &[u8]) {
        let now = self.begun.elapsed();
        let mut arq = lock(&self.arq);
        for byte in bytes {
            if let Some(frame) = self.reader.push(*byte) {
                arq.hear(now, frame);
            }
        }
    }

    /// Gives the owner what there is. What it has no room for stays, and holds the other side back.
    fn hand_over(&mut self) {
        loop {
            let next = self.held.take().or_else(|| self.next_event());
            let Some(event) = next else { return };
            if let Err(TrySendError::Full(event)) = self.events.try_send(event) {
                self.held = Some(event);
                return;
            }
        }
    }

    fn next_event(&mut self) -> Option<TransportEvent> {
        let mut arq = lock(&self.arq);
        match arq.event() {
            Some(ArqEvent::Linked) => {
                self.attempt = 0;
                return Some(TransportEvent::Connected);
            }
            Some(ArqEvent::Lost) => {
                drop(arq);
                return Some(self.disconnected("the other side is silent"));
            }
            None => {}
        }
        while let Some(letter) = arq.message() {
            if let Some((topic, payload)) = letter::open(letter) {
                return Some(TransportEvent::Incoming { topic, payload });
            }
        }
        None
    }

    fn fail(&mut self, what: &str) {
        let event = self.disconnected(what);
        self.held.get_or_insert(event);
        self.hand_over();
    }

    fn disconnected(&mut self, what: &str) -> TransportEvent {
        self.attempt += 1;
        let attempt = self.attempt;
        let reason = format!("serial line {}: {what} (attempt {attempt})", self.name);
        TransportEvent::Disconnected { attempt, reason }
    }

    fn is_stopping(&self) -> bool {
        self.is_stopping.load(Ordering::Relaxed)
    }
}

/// Writes all, however often the port has no room for a moment.
fn write_all(port: &mut dyn Port, mut bytes: &[u8]) -> io::Result<()> {
    let until = Instant::now() + WRITE_TIMEOUT;
    while !bytes.is_empty() {
        match port.write(bytes) {
            Ok(written) => bytes = &bytes[written..],
            Err(error) if is_passing(&error) && Instant::now() < until => std::thread::sleep(LISTEN / 5),
            Err(error) => return Err(error),
        }
    }
    Ok(())
}

fn is_passing(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::TimedOut | io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted)
}
