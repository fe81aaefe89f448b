//! MQTT by rumqttc, on a thread of its own, so that the connection lives while its owner computes.

use std::time::Duration;

use crate::{Identity, PublishError, Transport, TransportEvent};

/// Where a broker listens: `mqtt://host:port`, `host:port` or `host` (port 1883).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BrokerAddress {
    /// Name or number of the host.
    pub host: String,
    /// TCP port.
    pub port: u16,
}

impl std::fmt::Display for BrokerAddress {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}:{}", self.host, self.port)
    }
}

/// What is wrong with the text of an address.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("broker address {text:?}: write mqtt://host:port")]
pub struct BadAddress {
    text: String,
}

impl std::str::FromStr for BrokerAddress {
    type Err = BadAddress;

    fn from_str(text: &str) -> Result<Self, BadAddress> {
        Err(BadAddress { text: text.to_owned() })
    }
}

/// How to connect.
#[derive(Clone, Debug)]
pub struct MqttConfig {
    /// Where to.
    pub broker: BrokerAddress,
    /// As whom; gives client id and last will.
    pub identity: Identity,
}

/// A client of an MQTT broker.
#[derive(Debug)]
pub struct MqttTransport {}

impl MqttTransport {
    /// Starts to connect; success and failure come as events.
    pub fn start(_config: MqttConfig) -> Self {
        Self {}
    }
}

impl Transport for MqttTransport {
    fn subscribe(&mut self, _filter: &str) {}

    fn publish(&mut self, _topic: &str, _payload: &[u8], _retain: bool) -> Result<(), PublishError> {
        unimplemented!("lands soon")
    }

    fn poll(&mut self, _timeout: Duration) -> Option<TransportEvent> {
        unimplemented!("lands soon")
    }
}
