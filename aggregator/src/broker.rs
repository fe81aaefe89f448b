//! The embedded MQTT broker.

use std::io::ErrorKind;
use std::net::{SocketAddr, TcpListener};
use std::thread::JoinHandle;
use std::time::Duration;

use cosurf_wire::{MAX_MESSAGE_BYTES, MAX_TOPIC_BYTES};
use mqtt5::broker::MqttBroker;
use mqtt5::broker::config::{BrokerConfig, StorageBackend, StorageConfig};
use mqtt5::broker::server::BrokerShutdownHandle;

/// Devices at once.
const CLIENTS_MAX: usize = 1024;
/// Largest packet, with room for the properties of MQTT 5.
const PACKET_BYTES_MAX: usize = MAX_MESSAGE_BYTES + MAX_TOPIC_BYTES + 1024;
/// Headers and births that are kept for those who come later.
const RETAINED_MAX: usize = 4 * CLIENTS_MAX;
/// Messages that wait for one client.
const QUEUE_MAX: usize = 512;
/// Their bytes.
const QUEUE_BYTES_MAX: usize = 32 << 20;
/// A client that stays away longer is forgotten.
const SESSION_EXPIRY: Duration = Duration::from_secs(3600);

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
pub struct Broker {
    address: SocketAddr,
    handle: BrokerShutdownHandle,
    thread: Option<JoinHandle<()>>,
}

impl std::fmt::Debug for Broker {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Broker").field("address", &self.address).finish()
    }
}

impl Broker {
    /// Listens on `address`; port 0 takes a free one, see [`Self::address`].
    pub fn start(address: SocketAddr) -> Result<Self, BrokerError> {
        let io = |source: std::io::Error| match source.kind() {
            ErrorKind::AddrInUse => BrokerError::PortInUse(address),
            _ => BrokerError::Io { address, source },
        };
        drop(TcpListener::bind(address).map_err(io)?);
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(io)?;
        let started = runtime.block_on(MqttBroker::with_config(config(address)));
        let mut broker = started.map_err(|error| io(std::io::Error::other(error)))?;
        let address = broker.local_addr().unwrap_or(address);
        let handle = broker.shutdown_handle();
        let thread = std::thread::spawn(move || {
            let _ = runtime.block_on(broker.run());
        });
        Ok(Self { address, handle, thread: Some(thread) })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Ends all connections and waits until the port is free.
    pub fn shutdown(self) {
        drop(self);
    }
}

impl Drop for Broker {
    fn drop(&mut self) {
        self.handle.shutdown();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn config(address: SocketAddr) -> BrokerConfig {
    let storage = StorageConfig {
        backend: StorageBackend::Memory,
        max_queued_messages_per_client: QUEUE_MAX,
        max_queued_bytes_per_client: QUEUE_BYTES_MAX,
        ..StorageConfig::default()
    };
    BrokerConfig {
        max_retained_messages: RETAINED_MAX,
        max_retained_message_size: PACKET_BYTES_MAX,
        client_channel_capacity: QUEUE_MAX,
        max_subscriptions_per_client: 16,
        session_expiry_interval: SESSION_EXPIRY,
        topic_alias_maximum: 0,
        sys_topics_enabled: false,
        ..BrokerConfig::default()
            .with_bind_address(address)
            .with_max_clients(CLIENTS_MAX)
            .with_max_packet_size(PACKET_BYTES_MAX)
            .with_storage(storage)
    }
}
