//! How a part of this program reaches a broker.

use cosurf_link::{BrokerAddress, Identity, Login, MqttConfig, Tls};

/// How to reach a broker.
#[derive(Clone, Debug)]
pub struct Reach {
    /// The broker's address.
    pub broker: BrokerAddress,
    /// Certificates, if the broker requires TLS.
    pub tls: Option<Tls>,
    /// User and password, if the broker asks for them.
    pub login: Option<Login>,
}

impl Reach {
    /// Reaches a broker that asks for neither certificate nor password.
    pub fn plain(broker: BrokerAddress) -> Self {
        Self { broker, tls: None, login: None }
    }

    /// The settings of a client that connects as `identity`.
    pub fn config(&self, identity: Identity) -> MqttConfig {
        let Self { broker, tls, login } = self.clone();
        MqttConfig { broker, identity, tls, login }
    }
}
