//! Addresses of brokers.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// Default port without TLS (IANA).
const DEFAULT_PORT: u16 = 1883;
/// Default port with TLS (IANA).
const DEFAULT_PORT_TLS: u16 = 8883;

/// The address of a broker. Without TLS: `mqtt://host:port`, `host:port` or `host` (default port 1883). With
/// TLS: `mqtts://host:port` (default port 8883).
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct BrokerAddress {
    /// Host name or IP address.
    pub host: String,
    /// TCP port.
    pub port: u16,
    /// Whether the broker requires TLS.
    pub is_tls: bool,
}

impl fmt::Display for BrokerAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", self.socket_host(), self.port)
    }
}

impl BrokerAddress {
    /// The host as it is written before a port, with brackets around an IPv6 address.
    pub(super) fn socket_host(&self) -> String {
        if self.host.contains(':') { format!("[{}]", self.host) } else { self.host.clone() }
    }
}

/// The error for a text that is not a broker's address.
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
        let error = || BadAddress { text: text.to_owned() };
        let after_mqtts = text.strip_prefix("mqtts://");
        let rest = after_mqtts.or_else(|| text.strip_prefix("mqtt://")).unwrap_or(text);
        let rest = rest.strip_suffix('/').unwrap_or(rest);
        let (host, port) = match rest.strip_prefix('[').and_then(|rest| rest.split_once(']')) {
            Some((host, port)) => (host, port.strip_prefix(':')),
            None => rest.split_once(':').map_or((rest, None), |(host, port)| (host, Some(port))),
        };
        let is_bracketed = rest.starts_with('[');
        let allowed = |c: char| c.is_ascii_alphanumeric() || "-._".contains(c) || (is_bracketed && c == ':');
        if host.is_empty() || !host.chars().all(allowed) {
            return Err(error());
        }
        let is_tls = after_mqtts.is_some();
        let default = if is_tls { DEFAULT_PORT_TLS } else { DEFAULT_PORT };
        let port = port.map_or(Ok(default), |port| port.parse().map_err(|_| error()))?;
        Ok(Self { host: host.to_owned(), port, is_tls })
    }
}

impl TryFrom<String> for BrokerAddress {
    type Error = BadAddress;

    fn try_from(text: String) -> Result<Self, BadAddress> {
        text.parse()
    }
}

impl From<BrokerAddress> for String {
    /// Writes the address as a URL, which parses back to the same address.
    fn from(address: BrokerAddress) -> Self {
        let scheme = if address.is_tls { "mqtts" } else { "mqtt" };
        format!("{scheme}://{address}")
    }
}
