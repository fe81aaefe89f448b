//! Connects an agent to its aggregator: through an MQTT broker, or by a radio on a serial port.

use std::num::NonZeroU32;
use std::time::Duration;

use anyhow::{Context, Result};
use cosurf_contract::{AgentConfig, AgentLink, read_password};
use cosurf_link::serial::DEVICE_MESSAGE_BYTES;
use cosurf_link::{
    BrokerAddress, Identity, Login, MqttConfig, MqttTransport, Outgoing, PublishError, SecretKey,
    SerialConfig, SerialTransport, Tls, Transport, TransportEvent, is_present, last_will,
};
use cosurf_wire::DeviceId;

/// The address of the broker or the serial port, the content of the certificate files, and the password.
pub(super) enum Route {
    Broker { broker: BrokerAddress, tls: Option<Tls>, login: Option<Login> },
    Serial { port: String, baud: NonZeroU32 },
}

impl Route {
    /// The route of the device with this name, which is its user at the broker.
    pub(super) fn of(config: &AgentConfig, device: DeviceId) -> Result<Self> {
        Ok(match config.link()? {
            AgentLink::Broker { address, tls } => Self::Broker {
                broker: address.clone(),
                tls: Tls::for_broker(address, tls).context("tls")?,
                login: read_password(config.password_file.as_deref())?
                    .map(|password| Login { user: device.to_string(), password }),
            },
            AgentLink::Serial { port, baud } => Self::Serial { port: port.to_owned(), baud },
        })
    }

    /// Starts to connect in the background. The connection reports success and failure as events. `key` signs
    /// the notice that the broker publishes when the connection breaks.
    pub(super) fn connect(&self, identity: Identity, key: Option<&SecretKey>) -> Connection {
        self.connect_by(MqttTransport::start, identity, key)
    }

    /// The same for a connection that only reports, while the agent trains.
    pub(super) fn connect_reporting(&self, identity: Identity, key: Option<&SecretKey>) -> Connection {
        self.connect_by(MqttTransport::start_reporting, identity, key)
    }

    /// The same before a flight, beside what the broker keeps for the device itself.
    pub(super) fn connect_asking(&self, identity: Identity, key: Option<&SecretKey>) -> Connection {
        self.connect_by(MqttTransport::start_asking, identity, key)
    }

    fn connect_by(
        &self,
        start: fn(MqttConfig) -> MqttTransport,
        identity: Identity,
        key: Option<&SecretKey>,
    ) -> Connection {
        match self {
            Self::Broker { broker, tls, login } => {
                let (broker, tls, login) = (broker.clone(), tls.clone(), login.clone());
                let will = Some(last_will(&identity, key));
                Connection::Broker(start(MqttConfig { broker, identity, will, tls, login }))
            }
            Self::Serial { port, baud } => {
                let config = SerialConfig::device(port, *baud, identity.session, DEVICE_MESSAGE_BYTES);
                Connection::Serial(SerialTransport::start(config))
            }
        }
    }

    /// Whether another program is connected to the broker under the name of this device. An error is the reason why the
    /// broker does not tell. A radio has no names.
    pub(super) fn is_name_taken(&self, identity: Identity) -> Result<bool, String> {
        match self {
            Self::Broker { broker, tls, login } => {
                let (broker, tls, login) = (broker.clone(), tls.clone(), login.clone());
                is_present(MqttConfig { broker, identity, will: None, tls, login })
            }
            Self::Serial { .. } => Ok(false),
        }
    }

    /// Why there may be no connection although no error has come, after this time.
    pub(super) fn unheard(&self, after: Duration) -> String {
        let seconds = after.as_secs();
        match self {
            Self::Broker { broker, .. } => format!(
                "broker {broker}: no answer after {seconds} s: check the address, and that a broker listens there"
            ),
            Self::Serial { port, .. } => format!(
                "serial line {port}: no answer after {seconds} s: check that the aggregator's radio is on and in reach"
            ),
        }
    }

    /// Whether the line is a radio.
    pub(super) fn is_radio(&self) -> bool {
        matches!(self, Self::Serial { .. })
    }

    /// The flights of all devices count as received once no flight has arrived for this long. A radio needs more time
    /// than a broker.
    pub(super) fn quiet_time(&self) -> Duration {
        match self {
            Self::Broker { .. } => Duration::from_secs(2),
            Self::Serial { .. } => Duration::from_secs(20),
        }
    }

    /// How long the connection stays open at the end, so that the last messages are sent.
    pub(super) fn flush_time(&self) -> Duration {
        match self {
            Self::Broker { .. } => Duration::from_secs(1),
            Self::Serial { .. } => Duration::from_secs(10),
        }
    }
}

/// A connection that runs in the background.
pub(super) enum Connection {
    Broker(MqttTransport),
    Serial(SerialTransport),
}

impl Connection {
    /// Whether a broker takes the messages, and may refuse them.
    pub(super) fn has_broker(&self) -> bool {
        matches!(self, Self::Broker(_))
    }
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
