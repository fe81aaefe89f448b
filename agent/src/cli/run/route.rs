//! How an agent reaches its aggregator: through a broker, or by a radio on a serial port.

use std::num::NonZeroU32;
use std::time::Duration;

use anyhow::Result;
use cosurf_contract::{AgentConfig, AgentLink};
use cosurf_link::serial::DEVICE_MESSAGE_BYTES;
use cosurf_link::{
    BrokerAddress, Identity, MqttConfig, MqttTransport, Outgoing, PublishError, SerialConfig,
    SerialTransport, Tls, Transport, TransportEvent,
};

/// What is needed to connect, with the certificates read.
pub(super) enum Route {
    Broker { broker: BrokerAddress, tls: Option<Tls> },
    Serial { port: String, baud: NonZeroU32 },
}

impl Route {
    pub(super) fn of(config: &AgentConfig) -> Result<Self> {
        Ok(match config.link()? {
            AgentLink::Broker { address, tls } => {
                Self::Broker { broker: address.clone(), tls: Tls::for_broker(address, tls)? }
            }
            AgentLink::Serial { port, baud } => Self::Serial { port: port.to_owned(), baud },
        })
    }

    /// Starts to connect in the background; success and failure come as events.
    pub(super) fn connect(&self, identity: Identity) -> Connection {
        match self {
            Self::Broker { broker, tls } => {
                let (broker, tls) = (broker.clone(), tls.clone());
                Connection::Broker(MqttTransport::start(MqttConfig { broker, identity, tls }))
            }
            Self::Serial { port, baud } => {
                let config = SerialConfig::device(port, *baud, identity.session, DEVICE_MESSAGE_BYTES);
                Connection::Serial(SerialTransport::start(config))
            }
        }
    }

    /// After this much silence all retained messages have arrived.
    pub(super) fn quiet_time(&self) -> Duration {
        match self {
            Self::Broker { .. } => Duration::from_secs(2),
            Self::Serial { .. } => Duration::from_secs(20),
        }
    }

    /// How long the connection stays open for its last messages.
    pub(super) fn flush_time(&self) -> Duration {
        match self {
            Self::Broker { .. } => Duration::from_secs(1),
            Self::Serial { .. } => Duration::from_secs(10),
        }
    }
}

/// An open connection.
pub(super) enum Connection {
    Broker(MqttTransport),
    Serial(SerialTransport),
}

impl Transport for Connection {
    fn publish(&mut self, message: &Outgoing) -> Result<(), PublishError> {
        match self {
            Self::Broker(transport) => transport.publish(message),
            Self::Serial(transport) => transport.publish(message),
        }
    }

    fn poll(&mut self, timeout: Duration) -> Option<TransportEvent> {
        match self {
            Self::Broker(transport) => transport.poll(timeout),
            Self::Serial(transport) => transport.poll(timeout),
        }
    }
}
