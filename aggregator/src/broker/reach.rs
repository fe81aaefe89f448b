//! How a part of this program reaches a broker.

use std::path::PathBuf;

use cosurf_link::mqtt::TlsError;
use cosurf_link::{
    BrokerAddress, Identity, Login, MqttConfig, Outgoing, SecretKey, Tls, TlsFiles, last_will,
};

/// How to reach a broker.
#[derive(Clone, Debug)]
pub struct Reach {
    /// The broker's address.
    pub broker: BrokerAddress,
    /// Certificates, if the broker requires TLS.
    pub tls: Option<Tls>,
    /// User and password, if the broker asks for them.
    pub login: Option<Login>,
    /// The folder with the certificates of devices on serial lines, and the file of the authorities for them; `None` to
    /// connect for these devices like for this program.
    pub lines: Option<(PathBuf, PathBuf)>,
}

impl Reach {
    /// Reaches a broker that asks for neither certificate nor password.
    pub fn plain(broker: BrokerAddress) -> Self {
        Self { broker, tls: None, login: None, lines: None }
    }

    /// The settings of a client that connects as `identity`. `key` signs its last will.
    pub fn config(&self, identity: Identity, key: Option<&SecretKey>) -> MqttConfig {
        let Self { broker, tls, login, .. } = self.clone();
        MqttConfig { broker, identity, will: Some(last_will(&identity, key)), tls, login }
    }

    /// The settings of a client for the device `identity` on a serial line. `will` is the device's own last will.
    pub(crate) fn config_of_line(
        &self,
        identity: Identity,
        will: Option<Outgoing>,
    ) -> Result<MqttConfig, TlsError> {
        let mut config = MqttConfig { will, ..self.config(identity, None) };
        if let Some((folder, ca)) = &self.lines {
            let own = |end: &str| Some(folder.join(format!("{}.{end}", identity.device)));
            config.tls = Some(Tls::read(&TlsFiles { ca: ca.clone(), cert: own("pem"), key: own("key") })?);
        }
        Ok(config)
    }
}
