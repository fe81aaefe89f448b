//! The embedded MQTT broker.

use std::net::SocketAddr;

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
}

impl Broker {
    /// Listens on `address`; port 0 takes a free one, see [`Self::address`].
    pub fn start(_address: SocketAddr) -> Result<Self, BrokerError> {
        unimplemented!("lands soon")
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Ends all connections and waits until the port is free.
    pub fn shutdown(self) {
        unimplemented!("lands soon")
    }
}
