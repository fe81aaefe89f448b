//! An MQTT 5 broker inside the aggregator, so that a ground station needs only one program.
//!
//! Its features are few on purpose: QoS 0 and 1, retained messages, last wills, wildcards, and sessions
//! that outlive a connection. It has no authentication, no TLS and no storage on disk. By default it
//! therefore listens on loopback only. On a shared network, use Mosquitto by its URL instead. A restart of
//! the broker loses all messages; the devices then publish theirs again.
//!
//! Why not an existing broker: this one needs only the packet codec of rumqttc, which is linked anyway.
//! The alternatives:
//!
//! - `mqtt5` 0.49 adds many times the packages and build time of rumqttc. If a shutdown is requested
//!   before its loop has subscribed to the shutdown signal, the request is lost and `run` never returns.
//!   If the queue of a client is full, it drops QoS 1 messages.
//! - `rumqttd` 0.20 has no shutdown (rumqtt#771) and sends a new subscriber at most 100 retained messages.
//!
//! This broker adds no package, and accepts clients as soon as [`Broker::start`] returns. Before it drops
//! a message for a slow subscriber, it makes the publisher wait.
//!
//! What it knows nothing about: the meaning of the messages. Any MQTT 5 client may use it.
//!
//! Where to start reading: [`router`], which makes all decisions and uses no socket; then [`connection`],
//! which only reads and writes packets.

mod connection;
mod router;
mod session;

use std::fmt;
use std::io::{self, ErrorKind};
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;

use cosurf_link::BrokerAddress;
use serde::Serialize;

use connection::Hub;

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

/// What a broker reports.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum BrokerEvent {
    /// A client is refused because too many are connected. Reported again only after a client was accepted.
    #[serde(rename = "broker_full")]
    Full {
        /// The limit on clients.
        clients_max: usize,
    },
}

impl fmt::Display for BrokerEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self::Full { clients_max } = self;
        write!(f, "broker: a client is refused: {clients_max} clients are connected; raise `clients_max`")
    }
}

/// A running broker; it stops when dropped.
#[derive(Debug)]
pub struct Broker {
    address: SocketAddr,
    hub: Arc<Hub>,
    is_stopping: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Broker {
    /// Starts a broker for at most [`CLIENTS_MAX`] clients, see [`Self::start_for`].
    pub fn start(address: SocketAddr) -> Result<Self, BrokerError> {
        Self::start_for(address, CLIENTS_MAX, |_| ())
    }

    /// Listens on `address`. Port 0 takes a free port, which [`Self::address`] returns. Clients may connect as soon as this
    /// function returns, at most `clients_max` at once. `say` gets the broker's events.
    pub fn start_for(
        address: SocketAddr,
        clients_max: usize,
        say: impl Fn(BrokerEvent) + Send + 'static,
    ) -> Result<Self, BrokerError> {
        let failed = |cause: io::Error| match cause.kind() {
            ErrorKind::AddrInUse => BrokerError::PortInUse(address),
            _ => BrokerError::Io { address, cause },
        };
        let listener = TcpListener::bind(address).map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        let (hub, is_stopping) = (Arc::new(Hub::new(clients_max)), Arc::new(AtomicBool::new(false)));
        let (accepting, stop) = (Arc::clone(&hub), Arc::clone(&is_stopping));
        let thread = std::thread::spawn(move || accept(&listener, &accepting, clients_max, &stop, &say));
        Ok(Self { address, hub, is_stopping, thread: Some(thread) })
    }

    /// The address on which the broker listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Ends all connections and waits until the port is free. The last wills of the clients may not be
    /// delivered.
    pub fn shutdown(self) {
        drop(self);
    }
}

impl Drop for Broker {
    fn drop(&mut self) {
        self.is_stopping.store(true, Ordering::SeqCst);
        // Wakes the accepting thread. If this fails, the thread has ended already.
        let _ = TcpStream::connect(reachable(self.address));
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
        self.hub.close_all();
    }
}

fn accept(
    listener: &TcpListener,
    hub: &Arc<Hub>,
    clients_max: usize,
    is_stopping: &AtomicBool,
    say: &impl Fn(BrokerEvent),
) {
    let mut is_full = false;
    let mut readers: Vec<JoinHandle<()>> = Vec::new();
    for stream in listener.incoming() {
        if is_stopping.load(Ordering::SeqCst) {
            break;
        }
        readers.retain(|reader| !reader.is_finished());
        match stream {
            Ok(stream) if readers.len() < clients_max => {
                is_full = false;
                let hub = Arc::clone(hub);
                readers.push(std::thread::spawn(move || connection::serve(stream, &hub)));
            }
            // Dropping the stream closes it. The client tries again, so only the first refusal is told.
            Ok(_) => {
                if !std::mem::replace(&mut is_full, true) {
                    say(BrokerEvent::Full { clients_max });
                }
            }
            // Out of file descriptors, or the client left before it was accepted.
            Err(_) => std::thread::sleep(connection::ACCEPT_PAUSE),
        }
    }
    hub.close_all();
    for reader in readers {
        let _ = reader.join();
    }
}

/// The address by which this machine reaches its own broker, which listens on `listening`.
pub(crate) fn local_address(listening: SocketAddr) -> BrokerAddress {
    let address = reachable(listening);
    BrokerAddress { host: address.ip().to_string(), port: address.port(), is_tls: false }
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
