//! An MQTT broker inside the aggregator, so that a ground station needs only one program.
//!
//! It speaks MQTT 5 and MQTT 3.1.1: QoS 0 to 2, retained messages, last wills, wildcards, expiry, shared subscriptions,
//! and sessions that outlive a connection. It asks for passwords or certificates if told to, and uses TLS. It keeps nothing on disk: a
//! restart of the broker loses all messages; the devices then publish theirs again.
//!
//! Strangers must not be able to stop it, so everything it keeps has a bound:
//!
//! - One budget of bytes holds messages, queues, sessions, subscriptions and buffers ([`memory`]). Beyond it, the
//!   client that keeps the most loses its oldest messages, or is refused.
//! - A connection that has not said hello within 5 seconds ends. While too many have not, the oldest of the address
//!   that has the most of them ends.
//! - Known devices get in even if strangers hold all places ([`reactor`]).
//! - A slow subscriber misses messages; no publisher waits for it. Only parts of this program make publishers wait.
//!
//! Why not an existing broker: this one needs only the packet codecs of rumqttc, which is linked anyway, and mio, which
//! tokio brings. The alternatives:
//!
//! - `mqtt5` 0.49 adds many times the packages and build time of rumqttc. If a shutdown is requested
//!   before its loop has subscribed to the shutdown signal, the request is lost and `run` never returns.
//!   If the queue of a client is full, it drops QoS 1 messages.
//! - `rumqttd` 0.20 has no shutdown (rumqtt#771) and sends a new subscriber at most 100 retained messages.
//!
//! What it knows nothing about: the meaning of the messages. Any MQTT client may use it.
//!
//! Where to start reading: [`router`], which decides which message goes where and uses no socket; then [`reactor`],
//! the one thread that serves all sockets.

mod access;
mod client;
mod connection;
mod entrance;
mod event;
mod filters;
mod handshakes;
mod memory;
mod message;
mod packet;
mod reach;
mod reactor;
mod retained;
mod router;
mod session;
mod socket;
mod subscription;
mod tls;
mod topics;

use std::collections::BTreeSet;
use std::io::{self, ErrorKind};
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::sync::Arc;
use std::sync::mpsc::{self, Sender};
use std::thread::JoinHandle;
use std::time::Instant;

use cosurf_link::{BrokerAddress, Login};
use cosurf_wire::{DeviceId, SiteId};
use mio::net::TcpListener;
use mio::{Interest, Poll, Token, Waker};
use socket2::{Domain, Socket, Type};

pub use access::{ServerTls, Users, UsersError, user_line};
pub use event::BrokerEvent;
pub use reach::Reach;
pub use tls::BrokerTlsError;

use access::{Access, Verifier};
use connection::Door;
use entrance::{Entrance, guests_max};
use event::Teller;
use reactor::{Command, Parts, Reactor, WAKER};

/// Why the broker did not start.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BrokerError {
    /// Another program listens on this port.
    #[error(
        "port {port} on {host} is in use: stop the program that listens there, choose another port, or use that broker by its URL",
        port = .0.port(), host = .0.ip()
    )]
    PortInUse(SocketAddr),
    /// The certificates cannot be used.
    #[error(transparent)]
    Tls(#[from] BrokerTlsError),
    /// Any other error of the operating system.
    #[error("the broker cannot listen on {address}: {}", explain(cause))]
    Io {
        /// The address to listen on.
        address: SocketAddr,
        /// The operating system's error.
        cause: io::Error,
    },
}

/// An error of the operating system in words. The common kinds get a remedy.
fn explain(cause: &io::Error) -> String {
    match cause.kind() {
        ErrorKind::PermissionDenied => "permission denied; choose a port above 1023".to_owned(),
        ErrorKind::AddrNotAvailable => {
            "this computer has no such address; write 0.0.0.0 to listen on all its addresses".to_owned()
        }
        _ => cause.to_string(),
    }
}

/// Limit on the clients of a broker that is started without another limit.
pub const CLIENTS_MAX: usize = 1024;
/// Limit on the memory of a broker that is started without another limit, bytes.
pub const MEMORY_BYTES: usize = 128 << 20;
/// Smallest limit on the memory of a broker, bytes: a few models on their way.
pub const MEMORY_BYTES_MIN: usize = 16 << 20;
/// Connections that the system keeps until the broker accepts them. The standard library's 128 are soon full in a flood.
const WAITING_MAX: i32 = 4096;
/// Open files that are left to the rest of the program.
const OTHER_FILES: usize = 256;

/// What a broker allows.
#[derive(Clone, Debug)]
pub struct BrokerSettings {
    /// Limit on connected clients.
    pub clients_max: usize,
    /// Limit on the memory for clients, bytes, at least [`MEMORY_BYTES_MIN`].
    pub memory_bytes: usize,
    /// The users and their passwords; `None` to ask for no password.
    pub users: Option<Users>,
    /// The certificates for TLS; `None` for no TLS.
    pub tls: Option<ServerTls>,
    /// The site whose topics users may use; `None` for those of all sites.
    pub site: Option<SiteId>,
}

impl Default for BrokerSettings {
    fn default() -> Self {
        Self { clients_max: CLIENTS_MAX, memory_bytes: MEMORY_BYTES, users: None, tls: None, site: None }
    }
}

impl BrokerSettings {
    /// Whether everybody may connect.
    pub fn is_open(&self) -> bool {
        self.users.is_none() && self.tls.as_ref().is_none_or(|tls| tls.ca.is_none())
    }
}

/// A running broker; it stops when dropped.
#[derive(Debug)]
pub struct Broker {
    address: SocketAddr,
    house: Reach,
    commands: Commands,
    thread: Option<JoinHandle<()>>,
}

/// Hands commands to a broker's thread.
#[derive(Clone)]
struct Commands(Sender<Command>, Arc<Waker>);

impl std::fmt::Debug for Commands {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Commands")
    }
}

impl Commands {
    /// Does nothing if the thread has ended.
    fn send(&self, command: Command) {
        if self.0.send(command).is_ok() {
            let _ = self.1.wake();
        }
    }
}

impl Broker {
    /// Starts a broker with the default settings, which accepts everybody; see [`Self::start_with`].
    pub fn start(address: SocketAddr) -> Result<Self, BrokerError> {
        Self::start_with(address, BrokerSettings::default(), |_| ())
    }

    /// Listens on `address`. Port 0 takes a free port, which [`Self::address`] returns. Clients may connect as soon as this
    /// function returns. `say` gets the broker's events.
    pub fn start_with(
        address: SocketAddr,
        settings: BrokerSettings,
        say: impl Fn(BrokerEvent) + Send + 'static,
    ) -> Result<Self, BrokerError> {
        let failed = |cause: io::Error| match cause.kind() {
            ErrorKind::AddrInUse => BrokerError::PortInUse(address),
            _ => BrokerError::Io { address, cause },
        };
        let or_password = settings.users.is_some();
        let tls = settings.tls.as_ref().map(|files| tls::read(files, or_password)).transpose()?;
        let mut teller = Teller::new(say);
        let clients_max = allowed_clients(settings.clients_max, &mut teller);
        let is_open = settings.is_open();
        let secret = secret().map_err(failed)?;
        let takes_certificates = settings.tls.as_ref().is_some_and(|tls| tls.ca.is_some());
        let house_password = secret.to_hex().to_string();
        let access = Access {
            users: settings.users,
            takes_certificates,
            site: settings.site,
            house_password: house_password.clone(),
        };
        let poll = Poll::new().map_err(failed)?;
        let (front, address) = listen(&poll, address, 1).map_err(failed)?;
        let loopback = SocketAddr::new(Ipv4Addr::LOCALHOST.into(), 0);
        let (back, house) =
            listen(&poll, loopback, 2).map_err(|cause| BrokerError::Io { address: loopback, cause })?;
        if is_open && !address.ip().is_loopback() {
            teller.tell(Instant::now(), BrokerEvent::Open { address });
        }
        let (sender, commands) = mpsc::channel();
        let waker = Arc::new(Waker::new(poll.registry(), WAKER).map_err(failed)?);
        let sender = Commands(sender, waker);
        let answers = sender.clone();
        let tell = move |link, user, right| answers.send(Command::Verified(link, user, right));
        let reactor = Reactor::new(Parts {
            poll,
            entrances: vec![entrance(front, 1, Door::Front, tls), entrance(back, 2, Door::House, None)],
            commands,
            access: Arc::new(access),
            verifier: Verifier::start(*secret.as_bytes(), tell),
            memory_bytes: settings.memory_bytes.max(MEMORY_BYTES_MIN),
            clients_max,
            teller,
        });
        let thread = std::thread::spawn(move || reactor.run());
        let login = Login { user: "house".to_owned(), password: house_password };
        let house = Reach { login: Some(login), ..Reach::plain(local_address(house)) };
        Ok(Self { address, house, commands: sender, thread: Some(thread) })
    }

    /// The address on which the broker listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Where parts of this program connect, and how they prove what they are. Strangers cannot keep them out, and
    /// publishers wait for them.
    pub fn house(&self) -> Reach {
        self.house.clone()
    }

    /// What tells the broker the client ids of devices that it should prefer to strangers.
    pub fn introducer(&self) -> impl Fn(String) + Send + use<> {
        let commands = self.commands.clone();
        move |id| commands.send(Command::Know(id))
    }

    /// What tells the broker the users whose connections it must end and refuse, whatever certificate or password they
    /// show: all of them, each time.
    pub fn revoker(&self) -> impl Fn(BTreeSet<DeviceId>) + Send + use<> {
        let commands = self.commands.clone();
        move |users| commands.send(Command::Revoke(users))
    }

    /// Ends all connections and waits until the port is free. The last wills of the clients may not be
    /// delivered.
    pub fn shutdown(self) {
        drop(self);
    }
}

impl Drop for Broker {
    fn drop(&mut self) {
        self.commands.send(Command::Stop);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Random bytes that strangers cannot guess.
fn secret() -> io::Result<blake3::Hash> {
    let mut random = [0; 32];
    getrandom::fill(&mut random).map_err(io::Error::other)?;
    Ok(blake3::hash(&random))
}

fn listen(poll: &Poll, address: SocketAddr, token: usize) -> io::Result<(TcpListener, SocketAddr)> {
    let socket = Socket::new(Domain::for_address(address), Type::STREAM, None)?;
    // As in the standard library: a port is free at once after its program has ended.
    #[cfg(unix)]
    socket.set_reuse_address(true)?;
    socket.bind(&address.into())?;
    socket.listen(WAITING_MAX)?;
    socket.set_nonblocking(true)?;
    let mut listener = TcpListener::from_std(socket.into());
    let address = listener.local_addr()?;
    poll.registry().register(&mut listener, Token(token), Interest::READABLE)?;
    Ok((listener, address))
}

fn entrance(
    listener: TcpListener,
    token: usize,
    door: Door,
    tls: Option<Arc<rustls::ServerConfig>>,
) -> Entrance {
    Entrance { listener, token: Token(token), door, tls, is_ready: true }
}

/// As many of the wanted clients as the limit on open files allows, after raising it as far as possible. Each client
/// takes one file.
fn allowed_clients(wanted: usize, teller: &mut Teller<impl Fn(BrokerEvent)>) -> usize {
    let files = wanted + guests_max(wanted) + OTHER_FILES;
    let clients_max = match open_files(files) {
        Some(allowed) if allowed < files => (wanted * allowed.saturating_sub(OTHER_FILES / 2) / files).max(1),
        _ => wanted,
    };
    if clients_max < wanted {
        teller.tell(Instant::now(), BrokerEvent::FewFiles { wanted, clients_max });
    }
    clients_max
}

/// Raises the limit on open files to `wanted` if possible, and returns the limit; `None` if there is none.
#[cfg(unix)]
fn open_files(wanted: usize) -> Option<usize> {
    use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
    let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
    let current = current?;
    let goal = maximum.map_or(wanted as u64, |maximum| maximum.min(wanted as u64));
    if goal <= current || setrlimit(Resource::Nofile, Rlimit { current: Some(goal), maximum }).is_err() {
        return usize::try_from(current).ok();
    }
    usize::try_from(goal).ok()
}

#[cfg(not(unix))]
fn open_files(_wanted: usize) -> Option<usize> {
    None
}

/// The address by which this machine reaches its own broker, which listens on `listening`.
pub(crate) fn local_address(listening: SocketAddr) -> BrokerAddress {
    let address = reachable(listening);
    BrokerAddress::plain(address.ip().to_string(), address.port())
}

/// The address by which this machine reaches `address`: loopback if `address` stands for all interfaces.
fn reachable(address: SocketAddr) -> SocketAddr {
    let ip = match address.ip() {
        IpAddr::V4(ip) if ip.is_unspecified() => Ipv4Addr::LOCALHOST.into(),
        IpAddr::V6(ip) if ip.is_unspecified() => Ipv6Addr::LOCALHOST.into(),
        ip => ip,
    };
    SocketAddr::new(ip, address.port())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_broker_that_listens_everywhere_is_reached_here() {
        for (listening, host) in
            [("0.0.0.0:7", "127.0.0.1"), ("[::]:7", "::1"), ("192.168.0.9:7", "192.168.0.9")]
        {
            let address = local_address(listening.parse().unwrap());
            assert_eq!((address.host.as_str(), address.port), (host, 7));
        }
    }
}
