//! An embedded MQTT 5 broker, so that one program is enough on the ground.
//!
//! It is small on purpose: QoS 0 and 1, retained messages, last wills, wildcards, and sessions that outlive
//! a connection. It has no authentication, no TLS and no storage on disk, so it listens on loopback by
//! default; on a shared network use Mosquitto by its URL instead. When the broker restarts, devices publish
//! again what it has lost.
//!
//! Why our own: it needs only the packet codec of rumqttc, which is linked anyway. The alternatives:
//!
//! - `mqtt5` 0.49 adds many times the packages and build time of rumqttc. A shutdown requested before its
//!   loop has subscribed to the signal is lost, and `run` never returns. A full client queue drops QoS 1
//!   messages.
//! - `rumqttd` 0.20 has no shutdown (rumqtt#771) and sends a new subscriber at most 100 retained messages.
//!
//! Ours adds no package, accepts clients as soon as [`Broker::start`] returns, and holds a publisher back
//! before it drops QoS 1 messages for a slow subscriber.
//!
//! It refuses to know what the messages mean: any MQTT 5 client may use it.
//!
//! Where to start reading: [`router`] makes all decisions and knows no socket; [`connection`] only reads
//! and writes.

mod connection;
mod router;
mod session;

use std::io::ErrorKind;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;

use cosurf_link::BrokerAddress;

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
    #[error("the broker cannot listen on {address}: {source}")]
    Io {
        /// The address to listen on.
        address: SocketAddr,
        /// The operating system's error.
        source: std::io::Error,
    },
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
    /// Listens on `address`; port 0 takes a free port, see [`Self::address`]. Clients may connect as soon
    /// as this returns.
    pub fn start(address: SocketAddr) -> Result<Self, BrokerError> {
        let io = |source: std::io::Error| match source.kind() {
            ErrorKind::AddrInUse => BrokerError::PortInUse(address),
            _ => BrokerError::Io { address, source },
        };
        let listener = TcpListener::bind(address).map_err(io)?;
        let address = listener.local_addr().map_err(io)?;
        let (hub, is_stopping) = (Arc::new(Hub::default()), Arc::new(AtomicBool::new(false)));
        let (accepting, stop) = (Arc::clone(&hub), Arc::clone(&is_stopping));
        let thread = std::thread::spawn(move || accept(&listener, &accepting, &stop));
        Ok(Self { address, hub, is_stopping, thread: Some(thread) })
    }

    /// The address it listens on.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Ends all connections and waits until the port is free. Last wills are not published.
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

fn accept(listener: &TcpListener, hub: &Arc<Hub>, is_stopping: &AtomicBool) {
    let mut readers: Vec<JoinHandle<()>> = Vec::new();
    for stream in listener.incoming() {
        if is_stopping.load(Ordering::SeqCst) {
            break;
        }
        readers.retain(|reader| !reader.is_finished());
        match stream {
            Ok(stream) if readers.len() < router::CLIENTS_MAX => {
                let hub = Arc::clone(hub);
                readers.push(std::thread::spawn(move || connection::serve(stream, &hub)));
            }
            // Too many clients: dropping the stream closes it.
            Ok(_) => {}
            // Out of file descriptors, or the client left before it was accepted.
            Err(_) => std::thread::sleep(connection::ACCEPT_PAUSE),
        }
    }
    hub.close_all();
    for reader in readers {
        let _ = reader.join();
    }
}

/// How this machine reaches a broker of its own that listens there.
pub(crate) fn local_address(listening: SocketAddr) -> BrokerAddress {
    let address = reachable(listening);
    BrokerAddress { host: address.ip().to_string(), port: address.port(), is_tls: false }
}

/// The address by which this machine reaches `address`: loopback if that means all interfaces.
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
