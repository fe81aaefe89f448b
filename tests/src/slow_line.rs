//! A slow line that breaks, between a client and a broker on this computer.

use std::io::{ErrorKind, Read, Write};
use std::net::{Ipv4Addr, Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::{JoinHandle, sleep, spawn};
use std::time::{Duration, Instant};

use cosurf_link::BrokerAddress;
use socket2::{Domain, Protocol, Socket, Type};

/// How bad a line is.
#[derive(Clone, Copy, Debug)]
pub struct LineSettings {
    /// Rate in each direction, bytes per second.
    pub bytes_per_s: f64,
    /// Time from the end of a connection to the end of the next one: all connections are broken.
    pub cut_every: Option<Duration>,
    /// A time, counted from the start, in which the line carries nothing. Connections stay open.
    pub stall: Option<[Duration; 2]>,
    /// A time, counted from the start, in which nothing can be reached.
    pub away: Option<[Duration; 2]>,
}

impl LineSettings {
    /// A line that is only slow.
    pub fn slow(bytes_per_s: f64) -> Self {
        Self { bytes_per_s, cut_every: None, stall: None, away: None }
    }
}

/// What a modem keeps of the data that the line does not carry yet, bytes.
const BUFFER_BYTES: usize = 16 << 10;
/// Bytes that the line carries at once.
const PIECE_BYTES: usize = 512;

/// A running line. It ends when this value is dropped.
pub struct SlowLine {
    /// The client's side.
    pub address: BrokerAddress,
    shared: Arc<Shared>,
    threads: Vec<JoinHandle<()>>,
}

struct Shared {
    settings: LineSettings,
    start: Instant,
    broker: SocketAddr,
    is_over: AtomicBool,
    connections: Mutex<Vec<TcpStream>>,
    /// To the broker, and from it.
    directions: [Direction; 2],
}

struct Direction {
    /// When the line is free again.
    free: Mutex<Instant>,
    bytes: AtomicU64,
}

impl SlowLine {
    /// Starts a line to a broker on this computer.
    pub fn start(broker: &BrokerAddress, settings: LineSettings) -> Self {
        let (listener, start) = (listener(), Instant::now());
        let port = listener.local_addr().unwrap().port();
        let direction = || Direction { free: Mutex::new(start), bytes: AtomicU64::new(0) };
        let shared = Arc::new(Shared {
            settings,
            start,
            broker: (Ipv4Addr::LOCALHOST, broker.port).into(),
            is_over: AtomicBool::new(false),
            connections: Mutex::default(),
            directions: [direction(), direction()],
        });
        let threads = vec![
            spawn({
                let shared = Arc::clone(&shared);
                move || accept(&listener, &shared)
            }),
            spawn({
                let shared = Arc::clone(&shared);
                move || cut(&shared)
            }),
        ];
        Self { address: BrokerAddress::plain("127.0.0.1", port), shared, threads }
    }

    /// Bytes that the line has carried to the broker and from it.
    pub fn bytes(&self) -> [u64; 2] {
        [0, 1].map(|direction| self.shared.directions[direction].bytes.load(Ordering::Relaxed))
    }
}

impl Drop for SlowLine {
    fn drop(&mut self) {
        self.shared.is_over.store(true, Ordering::Relaxed);
        self.shared.cut();
        self.threads.drain(..).for_each(|thread| thread.join().unwrap());
    }
}

impl Shared {
    fn is_over(&self) -> bool {
        self.is_over.load(Ordering::Relaxed)
    }

    fn is_in(&self, span: Option<[Duration; 2]>) -> bool {
        let since = self.start.elapsed();
        span.is_some_and(|[from, to]| (from..to).contains(&since))
    }

    fn cut(&self) {
        for connection in self.connections.lock().unwrap().drain(..) {
            let _ = connection.shutdown(Shutdown::Both);
        }
    }
}

/// A listener whose connections have small buffers.
fn listener() -> TcpListener {
    let socket = Socket::new(Domain::IPV4, Type::STREAM, Some(Protocol::TCP)).unwrap();
    socket.set_recv_buffer_size(BUFFER_BYTES).unwrap();
    socket.bind(&SocketAddr::from((Ipv4Addr::LOCALHOST, 0)).into()).unwrap();
    socket.listen(8).unwrap();
    let listener = TcpListener::from(socket);
    listener.set_nonblocking(true).unwrap();
    listener
}

fn accept(listener: &TcpListener, shared: &Arc<Shared>) {
    while !shared.is_over() {
        match listener.accept() {
            Ok((client, _)) if shared.is_in(shared.settings.away) => drop(client),
            Ok((client, _)) => connect(client, shared),
            Err(_) => sleep(Duration::from_millis(5)),
        }
    }
}

fn connect(client: TcpStream, shared: &Arc<Shared>) {
    client.set_nonblocking(false).unwrap();
    let socket = Socket::new(Domain::IPV4, Type::STREAM, Some(Protocol::TCP)).unwrap();
    socket.set_recv_buffer_size(BUFFER_BYTES).unwrap();
    if socket.connect(&shared.broker.into()).is_err() {
        return;
    }
    let broker = TcpStream::from(socket);
    let mut connections = shared.connections.lock().unwrap();
    connections.extend([client.try_clone().unwrap(), broker.try_clone().unwrap()]);
    drop(connections);
    for (direction, from, to) in
        [(0, client.try_clone().unwrap(), broker.try_clone().unwrap()), (1, broker, client)]
    {
        let shared = Arc::clone(shared);
        spawn(move || carry(&shared, direction, from, to));
    }
}

/// Carries bytes in one direction, until the connection ends.
fn carry(shared: &Shared, direction: usize, mut from: TcpStream, mut to: TcpStream) {
    let mut piece = [0; PIECE_BYTES];
    let line = &shared.directions[direction];
    loop {
        let bytes = match from.read(&mut piece) {
            Err(error) if error.kind() == ErrorKind::Interrupted => continue,
            Err(_) | Ok(0) => break,
            Ok(bytes) => bytes,
        };
        let until = {
            let mut free = line.free.lock().unwrap();
            let time = Duration::from_secs_f64(bytes as f64 / shared.settings.bytes_per_s);
            *free = (*free).max(Instant::now()) + time;
            *free
        };
        sleep(until.saturating_duration_since(Instant::now()));
        while shared.is_in(shared.settings.stall) && !shared.is_over() {
            sleep(Duration::from_millis(50));
        }
        line.bytes.fetch_add(bytes as u64, Ordering::Relaxed);
        if to.write_all(&piece[..bytes]).is_err() {
            break;
        }
    }
    let _ = from.shutdown(Shutdown::Both);
    let _ = to.shutdown(Shutdown::Both);
}

/// Breaks connections when it is time to.
fn cut(shared: &Shared) {
    let mut at = shared.settings.cut_every;
    while !shared.is_over() {
        let since = shared.start.elapsed();
        if let (Some(due), Some(every)) = (at, shared.settings.cut_every)
            && since >= due
        {
            shared.cut();
            at = Some(due + every);
        }
        if shared.is_in(shared.settings.away) {
            shared.cut();
        }
        sleep(Duration::from_millis(10));
    }
}
