//! Why a service did not start, or ended by itself.

use std::net::SocketAddr;
use std::path::PathBuf;

use cosurf_contract::PasswordError;
use cosurf_engine::{DeviceChoice, DeviceError};
use cosurf_link::CredentialsError;
use cosurf_link::mqtt::TlsError;
use cosurf_scene::SceneError;

use crate::broker::{BrokerError, UsersError};
use crate::queue::QueueError;
use crate::service::config::WrongTls;
use crate::service::control::BROKER_ATTEMPTS_MAX;
use crate::service::error::ServiceError;
use crate::store::ObjectError;

/// Why a service did not start, or ended by itself.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ServeError {
    /// Neither or both of `bind` and `broker` are configured.
    #[error("write either bind = \"127.0.0.1:1883\" (a broker of its own) or broker = \"mqtt://host:port\"")]
    OneBroker,
    /// The certificates for the broker cannot be used.
    #[error("tls: {0}")]
    Tls(TlsError),
    /// The certificates for the broker of the aggregator above cannot be used.
    #[error("upstream.tls: {0}")]
    UpstreamTls(TlsError),
    /// `tls` does not fit the use that is made of it.
    #[error("tls: {0}")]
    TlsFile(#[from] WrongTls),
    /// The file of users cannot be used.
    #[error("users: {0}")]
    Users(#[from] UsersError),
    /// The built-in broker would accept everybody on the network.
    #[error(
        "bind: everybody who reaches {0} could read and send everything: write users = \"users.txt\" or tls with ca, \
         bind 127.0.0.1, or write open = true (--open) if all of the network may"
    )]
    Open(SocketAddr),
    /// A setting of the built-in broker is given, but the broker is elsewhere.
    #[error("{0} is for the built-in broker: remove it, or write bind instead of broker")]
    NotBuiltIn(&'static str),
    /// The password for the broker cannot be read.
    #[error(transparent)]
    Password(#[from] PasswordError),
    /// The site has keys, and those of the aggregator above are not given.
    #[error(
        "upstream.trusted is missing, but `trusted` is set: name the file with the key of the aggregator above"
    )]
    UpstreamTrusted,
    /// The file of a key, or a list of keys, cannot be used.
    #[error(transparent)]
    Credentials(#[from] CredentialsError),
    /// The device for merges cannot be opened.
    #[error("compute: {0}: {1}")]
    Compute(DeviceChoice, DeviceError),
    /// The folder of certificates for devices on radios is not there.
    #[error("line_certs: {}: there is no such folder; make it with `cosurf-aggregator pki`, or remove the line", .0.display())]
    LineCerts(PathBuf),
    /// The built-in broker did not start.
    #[error("bind: {0}")]
    Broker(BrokerError),
    /// The place of the workers' tiles cannot be used.
    #[error("workers.tiles: {0}")]
    Tiles(ObjectError),
    /// The workers' queue cannot be used.
    #[error("workers.queue: {0}")]
    Queue(QueueError),
    /// The plan could not be read, or the service's folder could not be made or written to.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The stores in the service's folder could not be opened.
    #[error(transparent)]
    Service(#[from] ServiceError),
    /// The broker was never reached.
    #[error(
        "{reason}; gave up after {BROKER_ATTEMPTS_MAX} attempts: check `broker`, and that the broker runs"
    )]
    NoBroker {
        /// The last error of the link.
        reason: String,
    },
}

impl ServeError {
    /// Whether a setting of the configuration file is wrong. The text then names the setting, and the caller must name
    /// the file.
    pub fn is_setting(&self) -> bool {
        !matches!(self, Self::Scene(_) | Self::Service(_))
    }
}
