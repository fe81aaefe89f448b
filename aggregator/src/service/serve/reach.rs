//! The brokers that a service uses: its own, that of its site, and that of the aggregator above.

use std::net::SocketAddr;
use std::path::Path;

use cosurf_contract::{PasswordError, read_password};
use cosurf_link::{BrokerAddress, Identity, Login, MqttConfig, Role, Tls};
use cosurf_wire::DeviceId;

use super::error::ServeError;
use crate::broker::{Broker, BrokerEvent, BrokerSettings, Reach, Users};
use crate::service::config::{AggregatorConfig, TlsConfig, UpstreamConfig};

/// Returns how to reach the broker. Starts the built-in broker if the configuration asks for it.
pub(super) fn reach_broker(
    config: &AggregatorConfig,
    say: impl Fn(BrokerEvent) + Send + 'static,
) -> Result<(Option<Broker>, Reach), ServeError> {
    match (config.bind, &config.broker) {
        (Some(bind), None) => {
            let broker = start_broker(config, bind, say)?;
            let reach = broker.house();
            Ok((Some(broker), reach))
        }
        (None, Some(address)) => Ok((None, reach_elsewhere(config, address)?)),
        _ => Err(ServeError::OneBroker),
    }
}

/// How to reach a broker elsewhere.
fn reach_elsewhere(config: &AggregatorConfig, address: &BrokerAddress) -> Result<Reach, ServeError> {
    if let Some(setting) = config.setting_of_built_in_broker() {
        return Err(ServeError::NotBuiltIn(setting));
    }
    let files = config.tls.as_ref().map(TlsConfig::of_client).transpose()?;
    let tls = Tls::for_broker(address, files.as_ref()).map_err(ServeError::Tls)?;
    let login = login(config.device, config.password_file.as_deref())?;
    if let Some(missing) = config.line_certs.as_ref().filter(|folder| !folder.is_dir()) {
        return Err(ServeError::LineCerts(missing.clone()));
    }
    let lines = config.line_certs.clone().zip(files.map(|files| files.ca));
    Ok(Reach { broker: address.clone(), tls, login, lines })
}

/// How an edge reaches the aggregator above.
pub(super) fn reach_above(above: &UpstreamConfig) -> Result<Reach, ServeError> {
    let broker = above.broker.clone();
    let tls = Tls::for_broker(&broker, above.tls.as_ref()).map_err(ServeError::UpstreamTls)?;
    let login = login(above.device, above.password_file.as_deref())?;
    Ok(Reach { tls, login, ..Reach::plain(broker) })
}

/// The brokers elsewhere that a service with this configuration connects to, each with the setting that names it. Fails
/// if the service could not start, because settings contradict each other or a file of them cannot be used.
/// `session` numbers the connections.
pub fn neighbours(
    config: &AggregatorConfig,
    session: u64,
) -> Result<Vec<(&'static str, MqttConfig)>, ServeError> {
    let identity = |site, device, role| Identity { site, device, session, role };
    let mut found = Vec::new();
    match (config.bind, &config.broker) {
        (Some(bind), None) => drop(broker_settings(config, bind)?),
        (None, Some(address)) => {
            let reach = reach_elsewhere(config, address)?;
            let identity = identity(config.site, config.device, Role::Aggregator);
            found.push(("broker", reach.config(identity, None)));
        }
        _ => return Err(ServeError::OneBroker),
    }
    if let Some(above) = &config.upstream {
        let identity = identity(above.site, above.device, Role::Device);
        found.push(("upstream", reach_above(above)?.config(identity, None)));
    }
    Ok(found)
}

/// Starts the built-in broker.
fn start_broker(
    config: &AggregatorConfig,
    bind: SocketAddr,
    say: impl Fn(BrokerEvent) + Send + 'static,
) -> Result<Broker, ServeError> {
    Broker::start_with(bind, broker_settings(config, bind)?, say).map_err(ServeError::Broker)
}

/// The settings of the built-in broker, unless it would accept everybody on the network unasked.
fn broker_settings(config: &AggregatorConfig, bind: SocketAddr) -> Result<BrokerSettings, ServeError> {
    if config.password_file.is_some() {
        return Err(ServeError::NotBuiltIn("users, not password_file,"));
    }
    let settings = BrokerSettings {
        clients_max: config.clients_max,
        memory_bytes: config.broker_memory_bytes,
        users: config.users.as_deref().map(Users::read).transpose()?,
        tls: config.tls.as_ref().map(TlsConfig::of_server).transpose()?,
        site: Some(config.site),
    };
    if settings.is_open() && !bind.ip().is_loopback() && !config.open {
        return Err(ServeError::Open(bind));
    }
    Ok(settings)
}

/// User and password for a broker, if there is a password.
fn login(device: DeviceId, file: Option<&Path>) -> Result<Option<Login>, PasswordError> {
    let password = read_password(file)?;
    Ok(password.map(|password| Login { user: device.to_string(), password }))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn one_broker_is_needed_and_one_only() {
        for brokers in ["", "bind = \"0.0.0.0:0\"\nbroker = \"mqtt://h:1\"\n"] {
            let config: AggregatorConfig =
                toml::from_str(&format!("site = \"s\"\nout = \"o\"\n{brokers}")).unwrap();
            assert!(matches!(reach_broker(&config, |_| ()), Err(ServeError::OneBroker)), "{brokers}");
        }
    }

    #[test]
    fn a_folder_of_certificates_that_is_not_there_is_told_at_the_start() {
        let settings =
            "site = \"s\"\nout = \"o\"\nbroker = \"mqtt://h:1\"\nline_certs = \"no-such-folder\"\n";
        let config: AggregatorConfig = toml::from_str(settings).unwrap();
        let error = reach_broker(&config, |_| ()).err().unwrap();
        assert!(
            error.is_setting() && error.to_string().starts_with("line_certs: no-such-folder: "),
            "{error}"
        );
    }

    #[test]
    fn neighbours_are_the_brokers_elsewhere() {
        let settings = "site = \"s\"\nout = \"o\"\nbroker = \"mqtt://h:1\"\n\
                        [upstream]\nsite = \"t\"\ndevice = \"s\"\nbroker = \"mqtt://above:1\"\n";
        let config: AggregatorConfig = toml::from_str(settings).unwrap();
        let found: Vec<_> = neighbours(&config, 7).unwrap().into_iter().map(|(name, _)| name).collect();
        assert_eq!(found, ["broker", "upstream"]);
        let settings = "site = \"s\"\nout = \"o\"\nbind = \"0.0.0.0:1883\"\n";
        let config: AggregatorConfig = toml::from_str(settings).unwrap();
        assert!(matches!(neighbours(&config, 7), Err(ServeError::Open(_))), "as `run` would refuse it");
    }
}
