//! Addresses of brokers.

use std::fmt;
use std::str::FromStr;

/// The ports of MQTT without and with TLS (IANA).
const DEFAULT_PORT: u16 = 1883;
const DEFAULT_PORT_TLS: u16 = 8883;

/// Where a broker listens: `mqtt://host:port`, `host:port` or `host` (port 1883); or with TLS
/// `mqtts://host:port` (port 8883).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BrokerAddress {
    /// Name or number of the host.
    pub host: String,
    /// TCP port.
    pub port: u16,
    /// Whether it wants TLS.
    pub is_tls: bool,
}

impl fmt::Display for BrokerAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", self.socket_host(), self.port)
    }
}

impl BrokerAddress {
    /// The host as it stands before a port: IPv6 numbers in brackets.
    pub(super) fn socket_host(&self) -> String {
        if self.host.contains(':') { format!("[{}]", self.host) } else { self.host.clone() }
    }
}

/// What is wrong with the text of an address.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "broker address {text:?}: write mqtt://host:port, or mqtts://host:port for TLS (no password, no path)"
)]
pub struct BadAddress {
    text: String,
}

impl FromStr for BrokerAddress {
    type Err = BadAddress;

    fn from_str(text: &str) -> Result<Self, BadAddress> {
        let bad = || BadAddress { text: text.to_owned() };
        let secured = text.strip_prefix("mqtts://");
        let rest = secured.or_else(|| text.strip_prefix("mqtt://")).unwrap_or(text);
        let rest = rest.strip_suffix('/').unwrap_or(rest);
        let (host, port) = match rest.strip_prefix('[').and_then(|rest| rest.split_once(']')) {
            Some((host, port)) => (host, port.strip_prefix(':')),
            None => rest.split_once(':').map_or((rest, None), |(host, port)| (host, Some(port))),
        };
        let is_bracketed = rest.starts_with('[');
        let allowed = |c: char| c.is_ascii_alphanumeric() || "-._".contains(c) || (is_bracketed && c == ':');
        if host.is_empty() || !host.chars().all(allowed) {
            return Err(bad());
        }
        let is_tls = secured.is_some();
        let usual = if is_tls { DEFAULT_PORT_TLS } else { DEFAULT_PORT };
        let port = port.map_or(Ok(usual), |port| port.parse().map_err(|_| bad()))?;
        Ok(Self { host: host.to_owned(), port, is_tls })
    }
}
