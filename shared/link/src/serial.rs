//! A serial line between one device and a gateway, such as a telemetry radio (SiK). It carries the protocol's
//! messages over [`Arq`], which repeats lost frames, and runs on its own thread.
//!
//! After an outage the transfer continues where it stopped. A restart of either side is detected by its
//! session number, and the protocol requests the missing chunks again. The clock is read only for timeouts
//! and for the pace of sending.

mod arq;
mod packet;
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

/// The usual baud rate of telemetry radios, in bits per second.
pub const DEFAULT_BAUD: NonZeroU32 = NonZeroU32::new(57_600).expect("not zero");
/// Largest message that a device sends, in bytes with its topic: about three seconds at [`DEFAULT_BAUD`].
pub const DEVICE_MESSAGE_BYTES: usize = 16 * 1024;
/// Largest message that a gateway sends, in bytes with its topic. The largest message of the protocol fits.
pub const GATEWAY_MESSAGE_BYTES: usize = packet::MAX_PACKET_BYTES - 1;

/// Timeout of a read from the port.
const READ_TIMEOUT: Duration = Duration::from_millis(10);
/// A port that accepts no bytes for this long is treated as lost.
const WRITE_TIMEOUT: Duration = Duration::from_secs(5);
/// Delays between attempts to open the port.
const REOPEN: Backoff = Backoff::new(Duration::from_millis(200), Duration::from_secs(5));
/// Bits on the line per byte: a start bit, eight data bits, a stop bit.
const BITS_PER_BYTE: u32 = 10;
/// Maximum number of events that wait for the caller. While the queue is full, the other side must wait
/// (backpressure).
const EVENTS_MAX: usize = 16;

/// A serial port, or another byte stream. Without input, a read must fail with [`io::ErrorKind::TimedOut`]
/// after some milliseconds.
pub trait Port: Read + Write + Send {}

impl<T: Read + Write + Send> Port for T {}

/// Opens a port. It is called again whenever the port is lost.
pub type OpenPort = Box<dyn FnMut() -> io::Result<Box<dyn Port>> + Send>;

/// The settings of one end of a line.
pub struct SerialConfig {
    /// Name of the line in error messages, such as `/dev/ttyUSB0`.
    pub name: String,
    /// Bandwidth of the line, in bytes per second.
    pub bytes_per_s: NonZeroU32,
    /// Number of this side's session. It must differ from the number of the previous session.
    pub session: u64,
    /// Largest message that this side sends, in bytes with its topic.
    pub message_bytes_max: usize,
    /// Opens the port.
    pub open: OpenPort,
}

impl SerialConfig {
    /// Settings for a serial port of this machine. `path` names the port, such as `/dev/ttyUSB0`.
    pub fn device(path: &str, baud: NonZeroU32, session: u64, message_bytes_max: usize) -> Self {
        let builder = serialport::new(path, baud.get()).timeout(READ_TIMEOUT);
        Self {
            name: path.to_owned(),
            bytes_per_s: NonZeroU32::new(baud.get() / BITS_PER_BYTE).unwrap_or(NonZeroU32::MIN),
            session,
            message_bytes_max,
            open: Box::new(move || Ok(Box::new(builder.clone().open().map_err(|error| told(error.into()))?))),
        }
    }
}

/// The error, in plain words and with the remedy if it is a usual one.
fn told(error: io::Error) -> io::Error {
    // What the call for the settings of a terminal says about anything else (POSIX ENOTTY).
    let text = error.to_string();
    match error.kind() {
        _ if text.contains("Not a typewriter") || text.contains("Inappropriate ioctl") => {
            io::Error::other("is no serial port: name one like /dev/ttyUSB0 as `serial`")
        }
        io::ErrorKind::NotFound => {
            io::Error::other("there is no such port: check its name, and that the radio is plugged in")
        }
        io::ErrorKind::PermissionDenied => io::Error::other(
            "this user may not open the port: add the user to the port's group, often `dialout`",
        ),
        _ => error,
    }
}

/// One end of a serial line. Dropping it discards the messages that have not been sent.
pub struct SerialTransport {
    arq: Arc<Mutex<Arq>>,
    message_bytes_max: usize,
    is_stopping: Arc<AtomicBool>,
    events: Receiver<TransportEvent>,
    thread: Option<JoinHandle<()>>,
}

impl SerialTransport {
    /// Starts the thread that opens the port and keeps it open. [`Transport::poll`] reports success and
    /// failure as events.
    pub fn start(config: SerialConfig) -> Self {
        // The lower 32 bits suffice, because they only have to tell consecutive sessions apart.
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
            start: Instant::now(),
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
        arq.queue(packet::join_packet(&message.topic, &message.payload));
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
            // A panic of the thread has already been printed.
            let _ = thread.join();
        }
    }
}

fn lock(arq: &Mutex<Arq>) -> MutexGuard<'_, Arq> {
    arq.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The thread that owns the port.
struct Worker {
    name: String,
    open: OpenPort,
    arq: Arc<Mutex<Arq>>,
    is_stopping: Arc<AtomicBool>,
    events: SyncSender<TransportEvent>,
    /// An event that the full queue has not accepted yet.
    held: Option<TransportEvent>,
    start: Instant,
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
                self.queue_events();
                std::thread::sleep(READ_TIMEOUT);
            }
        }
    }

    /// Sends and receives until the transport is dropped or the port fails.
    fn drive(&mut self, port: &mut dyn Port, reopen: &mut Backoff) -> io::Result<()> {
        let mut buffer = [0; 1024];
        while !self.is_stopping() {
            self.send(port)?;
            self.queue_events();
            match port.read(&mut buffer) {
                Ok(0) => return Err(io::ErrorKind::UnexpectedEof.into()),
                Ok(read) => {
                    reopen.reset();
                    self.receive(&buffer[..read]);
                }
                Err(error) if is_temporary(&error) => {}
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }

    fn send(&self, port: &mut dyn Port) -> io::Result<()> {
        let mut arq = lock(&self.arq);
        while let Some(frame) = arq.next_frame(self.start.elapsed()) {
            write_all(port, frame)?;
        }
        Ok(())
    }

    fn receive(&mut self, bytes: &[u8]) {
        let now = self.start.elapsed();
        let mut arq = lock(&self.arq);
        for byte in bytes {
            if let Some(frame) = self.reader.push(*byte) {
                arq.on_frame(now, frame);
            }
        }
    }

    /// Queues all events and messages for the caller. If the queue is full, the remaining ones stay in the
    /// [`Arq`], which then makes the other side wait.
    fn queue_events(&mut self) {
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
        match arq.next_event() {
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
        while let Some(packet) = arq.next_message() {
            if let Some((topic, payload)) = packet::split_packet(packet) {
                return Some(TransportEvent::Incoming { topic, payload });
            }
        }
        None
    }

    fn fail(&mut self, what: &str) {
        let event = self.disconnected(what);
        self.held.get_or_insert(event);
        self.queue_events();
    }

    fn disconnected(&mut self, what: &str) -> TransportEvent {
        self.attempt += 1;
        let attempt = self.attempt;
        let reason = format!("serial line {}: {what}", self.name);
        TransportEvent::Disconnected { attempt, reason }
    }

    fn is_stopping(&self) -> bool {
        self.is_stopping.load(Ordering::Relaxed)
    }
}

/// Writes all bytes. Retries while the port's buffer is full.
fn write_all(port: &mut dyn Port, mut bytes: &[u8]) -> io::Result<()> {
    let until = Instant::now() + WRITE_TIMEOUT;
    while !bytes.is_empty() {
        match port.write(bytes) {
            Ok(written) => bytes = &bytes[written..],
            Err(error) if is_temporary(&error) && Instant::now() < until => {
                std::thread::sleep(READ_TIMEOUT / 5)
            }
            Err(error) => return Err(error),
        }
    }
    Ok(())
}

fn is_temporary(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::TimedOut | io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted)
}
