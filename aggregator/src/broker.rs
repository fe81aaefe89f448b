//! The embedded MQTT 5 broker: so that one program is enough on the ground.
//!
//! It is small on purpose: QoS 0 and 1, retained messages, last wills, sessions that outlive a
//! connection, wildcards. No authentication, no TLS, no disk: it listens on loopback unless told
//! otherwise, and where strangers share the network, Mosquitto takes its place by URL. What is lost when
//! it stops is offered again by the devices.
//!
//! Why our own, on the packet codec of rumqttc, which is linked anyway. The crates measured for the job
//! (2-core x86-64, rustc 1.95):
//!
//! - `mqtt5` 0.49, features cut to `broker`: 126 more packages (argon2, hyper, ring, regex, ICU tables)
//!   beside rumqttc's 28; 102 s instead of 11 s for a cold release build; for tests, whose dependencies
//!   are optimised too, 4 more minutes of CPU. A shutdown requested before its loop has subscribed to the
//!   signal is lost and `run` never returns. Its limit of one client's queue drops QoS 1 messages.
//! - `rumqttd` 0.20: no shutdown (rumqtt#771), at most 100 retained messages for a new subscriber.
//!
//! Ours adds no package, is ready as soon as [`Broker::start`] returns, and holds back a publisher
//! instead of dropping QoS 1 messages for a slow consumer.
//!
//! It refuses to know what the messages mean: any MQTT 5 client may use it.
//!
//! Where to start reading: [`router`] decides and knows no socket; [`connection`] reads and writes and decides nothing.

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
    /// Somebody else listens there.
    #[error(
        "port {port} on {host} is in use: stop what listens there, choose another port, or use it by its URL",
        port = .0.port(), host = .0.ip()
    )]
    PortInUse(SocketAddr),
    /// Anything else the operating system says.
    #[error("broker on {address}: {source}")]
    Io {
        /// Where it should listen.
        address: SocketAddr,
        /// What the operating system said.
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
    /// Listens on `address`; port 0 takes a free one, see [`Self::address`]. Clients may connect as soon
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

    /// Where it listens.
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
        // Wakes the accepting thread; if nobody listens any more, it has ended already.
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
            // Too many: closed by being dropped.
            Ok(_) => {}
            // Out of file descriptors, or gone before it was accepted.
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

/// How this machine reaches an address that may mean every one of its own.
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
