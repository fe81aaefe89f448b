//! Addresses of brokers.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// Default port without TLS (IANA).
const DEFAULT_PORT: u16 = 1883;
/// Default port with TLS (IANA).
const DEFAULT_PORT_TLS: u16 = 8883;

/// Default port of WebSocket without TLS (RFC 6455).
const DEFAULT_PORT_WEB: u16 = 80;
/// Default port of WebSocket with TLS (RFC 6455).
const DEFAULT_PORT_WEB_TLS: u16 = 443;
/// Default path of WebSocket, which most brokers and proxies use.
const DEFAULT_WEB_PATH: &str = "/mqtt";

/// The address of a broker. Without TLS: `mqtt://host:port`, `host:port` or `host` (default port 1883). With
/// TLS: `mqtts://host:port` (default port 8883). By WebSocket, which passes the proxies of companies and phone networks:
/// `ws://host:port/path` or, with TLS, `wss://host:port/path` (default ports 80 and 443, default path `/mqtt`).
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct BrokerAddress {
    /// Host name or IP address.
    pub host: String,
    /// TCP port.
    pub port: u16,
    /// Whether the broker requires TLS.
    pub is_tls: bool,
    /// The path of the broker's WebSocket listener, from its `/`; `None` without WebSocket.
    pub web_path: Option<String>,
}

impl fmt::Display for BrokerAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}{}", self.authority(), self.web_path.as_deref().unwrap_or_default())
    }
}

impl BrokerAddress {
    /// An address with neither TLS nor WebSocket.
    pub fn plain(host: impl Into<String>, port: u16) -> Self {
        Self { host: host.into(), port, is_tls: false, web_path: None }
    }

    /// Host and port, with brackets around an IPv6 address.
    pub(super) fn authority(&self) -> String {
        let Self { host, port, .. } = self;
        if host.contains(':') { format!("[{host}]:{port}") } else { format!("{host}:{port}") }
    }
}

/// The error for a text that is not a broker's address.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "broker address {text:?}: write mqtt://host:port, mqtts://host:port for TLS, or ws:// or wss:// with a path for \
     WebSocket (no password)"
)]
pub struct BadAddress {
    text: String,
}

impl FromStr for BrokerAddress {
    type Err = BadAddress;

    fn from_str(text: &str) -> Result<Self, BadAddress> {
        let error = || BadAddress { text: text.to_owned() };
        let (scheme, rest) = text.split_once("://").unwrap_or(("mqtt", text));
        let (is_tls, is_web, default_port) = match scheme {
            "mqtt" => (false, false, DEFAULT_PORT),
            "mqtts" => (true, false, DEFAULT_PORT_TLS),
            "ws" => (false, true, DEFAULT_PORT_WEB),
            "wss" => (true, true, DEFAULT_PORT_WEB_TLS),
            _ => return Err(error()),
        };
        let (rest, path) = rest.split_at(rest.find('/').unwrap_or(rest.len()));
        let web_path = match (is_web, path) {
            (false, "" | "/") => None,
            (true, "") => Some(DEFAULT_WEB_PATH.to_owned()),
            (true, path) if path.bytes().all(|byte| byte.is_ascii_graphic()) => Some(path.to_owned()),
            _ => return Err(error()),
        };
        let (host, port) = match rest.strip_prefix('[').and_then(|rest| rest.split_once(']')) {
            Some((host, port)) => (host, port.strip_prefix(':')),
            None => rest.split_once(':').map_or((rest, None), |(host, port)| (host, Some(port))),
        };
        let is_bracketed = rest.starts_with('[');
        let allowed = |c: char| c.is_ascii_alphanumeric() || "-._".contains(c) || (is_bracketed && c == ':');
        if host.is_empty() || !host.chars().all(allowed) {
            return Err(error());
        }
        let port = port.map_or(Ok(default_port), |port| port.parse().map_err(|_| error()))?;
        Ok(Self { host: host.to_owned(), port, is_tls, web_path })
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
        let scheme = match (&address.web_path, address.is_tls) {
            (None, false) => "mqtt",
            (None, true) => "mqtts",
            (Some(_), false) => "ws",
            (Some(_), true) => "wss",
        };
        format!("{scheme}://{address}")
    }
}
