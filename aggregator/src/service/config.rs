//! `aggregator.toml`: the configuration of a service on the ground station.

use std::fs;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use cosurf_contract::{amount, parse_toml};
use cosurf_engine::DeviceChoice;
use cosurf_geo::Geodetic;
use cosurf_link::{BrokerAddress, DEVICES_MAX, TlsFiles};
use cosurf_scene::SceneError;
use cosurf_scene::bytes::format_bytes;
use cosurf_wire::{DeviceId, FrameId, SiteId};
use serde::de::Error;
use serde::{Deserialize, Deserializer};

use super::round::Rounds;
use crate::broker::{CLIENTS_MAX, MEMORY_BYTES, MEMORY_BYTES_MIN, ServerTls};
use crate::merge::MergeSettings;
use crate::partition::DEFAULT_MARGIN;

/// Largest limit on clients, devices and uploads that a configuration may give.
const LIMIT_MAX: usize = 16_384;
/// The least memory for uploads, bytes. Less can only be a mistake.
const MEMORY_BYTES_LEAST: u64 = 1 << 20;
/// The least memory for merges, bytes: what two small models of small pictures take.
const MERGE_BYTES_LEAST: u64 = 32 << 20;

/// The content of `aggregator.toml`. Relative paths are relative to the working folder.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AggregatorConfig {
    /// The site to serve.
    pub site: SiteId,
    /// The aggregator's own device id on that site.
    #[serde(default = "default_device")]
    pub device: DeviceId,
    /// The folder of the service; see [`crate::service`] for its content.
    #[serde(deserialize_with = "cosurf_contract::config::folder")]
    pub out: PathBuf,
    /// Address on which the built-in broker listens, for example `127.0.0.1:1883`; absent where `broker` is used. An
    /// address that other computers reach needs `users`, `tls` with `ca`, or `open`.
    #[serde(default, deserialize_with = "bind")]
    pub bind: Option<SocketAddr>,
    /// URL of the broker to use instead of the built-in one, for example `mqtt://10.0.0.2:1883`; absent where `bind` is
    /// used.
    pub broker: Option<BrokerAddress>,
    /// Certificates: with `bind` those of the built-in broker, with `broker` those for a broker at `mqtts://` or `wss://`.
    pub tls: Option<TlsConfig>,
    /// With `bind`: file of the users who may connect, for each one the line that the command `password` prints. Absent
    /// to ask for no password.
    pub users: Option<PathBuf>,
    /// With `bind`: true to accept everybody who reaches an address beyond this computer.
    #[serde(default)]
    pub open: bool,
    /// With `broker`: file of the password for the broker; its user is `device`. If absent, the environment variable
    /// `COSURF_PASSWORD` counts, if it is set.
    pub password_file: Option<PathBuf>,
    /// With `broker`: folder with the certificates of the devices on radios, `NAME.pem` and `NAME.key` for each device
    /// NAME. Absent to connect for these devices with the aggregator's own certificate, which not all brokers allow.
    pub line_certs: Option<PathBuf>,
    /// Name of the world frame of the coordinates; only models of this frame are merged. Absent for `local`: then a
    /// model that shares no ground with the others is kept out, because its frame may be another one.
    pub frame: Option<FrameId>,
    /// Where on the earth the world's origin is, written `LAT,LON,HEIGHT` in degrees and metres; absent if that is not known.
    #[serde(default, deserialize_with = "origin")]
    pub origin: Option<Geodetic>,
    /// File of the secret key that signs the global model, written by the command `key`; absent for no signature.
    pub key: Option<PathBuf>,
    /// File of the public keys whose models are accepted: for each key the line that the command `key` prints. Absent
    /// to accept all models.
    pub trusted: Option<PathBuf>,
    /// Limit on the clients of the built-in broker; further clients are refused.
    #[serde(default = "default_clients_max", deserialize_with = "limit")]
    pub clients_max: usize,
    /// `broker_memory`: limit on the memory that the built-in broker takes for messages, queues, sessions and buffers of
    /// its clients, for example `"128MiB"`; a number counts bytes.
    #[serde(
        rename = "broker_memory",
        alias = "broker_memory_bytes",
        default = "default_broker_memory_bytes",
        deserialize_with = "broker_memory"
    )]
    pub broker_memory_bytes: usize,
    /// Limit on the devices whose sessions are remembered, and whose requests for the global model are answered. Requests
    /// of devices that sent a model always are.
    #[serde(default = "default_devices_max", deserialize_with = "limit")]
    pub devices_max: usize,
    /// Limit on the number of concurrent uploads; further agents wait.
    #[serde(default = "default_uploads_max", deserialize_with = "limit")]
    pub uploads_max: usize,
    /// `memory`: limit on the bytes of concurrent uploads; further agents wait.
    #[serde(
        rename = "memory",
        alias = "memory_bytes",
        default = "default_memory_bytes",
        deserialize_with = "service_memory"
    )]
    pub memory_bytes: u64,
    /// `merge_memory`: limit on the memory that a merge takes.
    #[serde(
        rename = "merge_memory",
        alias = "merge_memory_bytes",
        default = "default_merge_memory_bytes",
        deserialize_with = "merge_memory"
    )]
    pub merge_memory_bytes: u64,
    /// The device that computes merges: `auto`, `cpu`, `gpu` or `gpu:N`.
    #[serde(default)]
    pub compute: DeviceChoice,
    /// False to leave every model where it is, instead of moving models so that the ground they share lies at the same
    /// place in all of them.
    #[serde(default = "default_refine")]
    pub refine: bool,
    /// Number of devices that must have sent a model before a merge begins. The deadline overrides this number.
    #[serde(default = "default_quorum", deserialize_with = "limit")]
    pub quorum: usize,
    /// Seconds without a new model after which a merge begins.
    #[serde(default = "default_quiet_s")]
    pub quiet_s: u64,
    /// Longest time that a merge waits for more models, seconds.
    #[serde(default = "default_deadline_s")]
    pub deadline_s: u64,
    /// GeoJSON file with the plan of the site: polygons with the property `device`, which names the drone that observes the
    /// polygon. Absent if each drone trains on all of its pictures.
    pub plan: Option<PathBuf>,
    /// With `plan`, width of the margin around each cell, as a share of the cell's size, 0 to 1. The cell's drone also
    /// trains on pictures that look at the margin.
    #[serde(default = "default_margin", deserialize_with = "margin")]
    pub margin: f64,
    /// The aggregator above this one; absent if there is none. With an aggregator above, this one is an edge: it
    /// uploads its global models like a device.
    pub upstream: Option<UpstreamConfig>,
    /// The workers on other computers that distil the tiles of merges; absent to distil them here.
    pub workers: Option<WorkersConfig>,
}

/// How an edge reaches the aggregator above it. World frame and secret key are those of the edge's own site.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UpstreamConfig {
    /// The site that the aggregator above serves.
    pub site: SiteId,
    /// Device id of the edge on that site, unique there.
    pub device: DeviceId,
    /// URL of the broker of that site, for example `mqtt://cloud.example.org:1883`.
    pub broker: BrokerAddress,
    /// Certificates for a broker at `mqtts://` or `wss://`.
    pub tls: Option<TlsFiles>,
    /// File of the password for the broker; its user is `device`.
    pub password_file: Option<PathBuf>,
    /// File of the public key of the aggregator above. Needed if the edge's own site has a list of keys.
    pub trusted: Option<PathBuf>,
}

/// Certificates of the built-in broker, or of a client of a broker elsewhere; all files in PEM.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TlsConfig {
    /// Certificates of the authorities. A client needs it. With it, the built-in broker asks its clients for
    /// certificates; the name (CN) in them must be that of the device.
    pub ca: Option<PathBuf>,
    /// The own certificate, followed by intermediate certificates.
    pub cert: Option<PathBuf>,
    /// The private key of `cert`.
    pub key: Option<PathBuf>,
    /// For the built-in broker: the list of revoked certificates.
    pub revoked: Option<PathBuf>,
}

/// A certificate that is missing for the use that is made of it, or that has none.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct WrongTls(&'static str);

impl TlsConfig {
    /// The files of a client.
    pub(super) fn of_client(&self) -> Result<TlsFiles, WrongTls> {
        if self.revoked.is_some() {
            return Err(WrongTls("remove revoked: only the built-in broker reads it"));
        }
        let ca = self.ca.clone().ok_or(WrongTls("ca is missing"))?;
        Ok(TlsFiles { ca, cert: self.cert.clone(), key: self.key.clone() })
    }

    /// The files of the built-in broker.
    pub(super) fn of_server(&self) -> Result<ServerTls, WrongTls> {
        match (self.cert.clone(), self.key.clone()) {
            (Some(cert), Some(key)) => {
                Ok(ServerTls { cert, key, ca: self.ca.clone(), revoked: self.revoked.clone() })
            }
            _ => Err(WrongTls("the built-in broker needs cert and key")),
        }
    }
}

/// How workers on other computers get tiles to distil.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WorkersConfig {
    /// URL of the NATS server with the queue, for example `nats://10.0.0.1:4222`.
    pub queue: String,
    /// Where tiles are kept: a folder, or a bucket like `s3://bucket/prefix`.
    pub tiles: String,
}

fn default_device() -> DeviceId {
    DeviceId::new("aggregator").expect("the name is valid")
}

fn default_clients_max() -> usize {
    CLIENTS_MAX
}

fn default_broker_memory_bytes() -> usize {
    MEMORY_BYTES
}

fn default_devices_max() -> usize {
    DEVICES_MAX
}

fn default_uploads_max() -> usize {
    256
}

fn default_memory_bytes() -> u64 {
    1 << 30
}

fn default_merge_memory_bytes() -> u64 {
    MergeSettings::default().memory_bytes
}

fn default_refine() -> bool {
    true
}

fn default_quorum() -> usize {
    Rounds::default().quorum
}

fn default_quiet_s() -> u64 {
    Rounds::default().quiet.as_secs()
}

fn default_deadline_s() -> u64 {
    Rounds::default().deadline.as_secs()
}

fn default_margin() -> f64 {
    DEFAULT_MARGIN
}

/// Reads the width of the margin.
fn margin<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    let margin = f64::deserialize(deserializer)?;
    match (0.0..=1.0).contains(&margin) {
        true => Ok(margin),
        false => Err(D::Error::custom("give a number from 0 to 1")),
    }
}

/// Reads a limit on a number of clients, devices or uploads. Each takes memory, and a client also an open file.
fn limit<'de, D: Deserializer<'de>>(deserializer: D) -> Result<usize, D::Error> {
    let number = usize::deserialize(deserializer)?;
    if (1..=LIMIT_MAX).contains(&number) {
        return Ok(number);
    }
    let remedy = "for more, divide the site among several edges";
    Err(D::Error::custom(format!("give a number from 1 to {LIMIT_MAX}; {remedy}")))
}

/// Reads the limit on the memory of uploads.
fn service_memory<'de, D: Deserializer<'de>>(deserializer: D) -> Result<u64, D::Error> {
    at_least(deserializer, MEMORY_BYTES_LEAST)
}

/// Reads the limit on the memory of a merge.
fn merge_memory<'de, D: Deserializer<'de>>(deserializer: D) -> Result<u64, D::Error> {
    at_least(deserializer, MERGE_BYTES_LEAST)
}

fn at_least<'de, D: Deserializer<'de>>(deserializer: D, least: u64) -> Result<u64, D::Error> {
    let bytes = amount(deserializer)?;
    match bytes >= least {
        true => Ok(bytes),
        false => Err(D::Error::custom(format!("give at least {}", format_bytes(least)))),
    }
}

/// Reads the limit on the built-in broker's memory.
fn broker_memory<'de, D: Deserializer<'de>>(deserializer: D) -> Result<usize, D::Error> {
    let bytes = usize::try_from(amount(deserializer)?).unwrap_or(usize::MAX);
    match bytes >= MEMORY_BYTES_MIN {
        true => Ok(bytes),
        false => {
            let least = format_bytes(MEMORY_BYTES_MIN as u64);
            Err(D::Error::custom(format!("give at least {least}")))
        }
    }
}

/// Reads the address to bind. The standard library's error does not tell how an address is written.
fn bind<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<SocketAddr>, D::Error> {
    let text = String::deserialize(deserializer)?;
    let wrong = |_| format!("{text:?}: write an IP address and a port, for example 127.0.0.1:1883");
    text.parse::<SocketAddr>().map(Some).map_err(wrong).map_err(D::Error::custom)
}

/// Reads the origin of the site.
fn origin<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<Geodetic>, D::Error> {
    String::deserialize(deserializer)?.parse().map(Some).map_err(D::Error::custom)
}

impl AggregatorConfig {
    /// A setting of the built-in broker that is given; `None` if there is none.
    pub(in crate::service) fn setting_of_built_in_broker(&self) -> Option<&'static str> {
        match () {
            () if self.users.is_some() => Some("users"),
            () if self.open => Some("open"),
            () => None,
        }
    }

    /// Reads a configuration file. The error names the file, and shows what is wrong in it.
    pub fn read(path: &Path) -> Result<Self, SceneError> {
        let text = fs::read_to_string(path).map_err(|cause| SceneError::io(path, cause))?;
        parse_toml(&text).map_err(|error| SceneError::malformed(path, error.to_string()))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    const REQUIRED: &str = "site = \"s\"\nout = \"o\"\n";

    fn read(text: &str) -> Result<AggregatorConfig, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("aggregator.toml");
        fs::write(&path, text).unwrap();
        let start = format!("{}: ", path.display());
        let shorten = |error: SceneError| error.to_string().strip_prefix(&start).unwrap().to_owned();
        AggregatorConfig::read(&path).map_err(shorten)
    }

    #[test]
    fn only_site_and_out_must_be_written() {
        let config = read(REQUIRED).unwrap();
        assert_eq!((config.device.as_str(), config.bind, config.quorum), ("aggregator", None, 1));
        assert_eq!((config.clients_max, config.devices_max, config.uploads_max), (1024, 1024, 256));
        assert_eq!((config.plan, config.margin), (None, 0.2));
        let config = read(&format!("{REQUIRED}clients_max = 16_384")).unwrap();
        assert_eq!(config.clients_max, 16_384);
        let config = read(&format!("{REQUIRED}merge_memory = \"2GiB\"\nmemory_bytes = 7000000")).unwrap();
        assert_eq!((config.merge_memory_bytes, config.memory_bytes), (2 << 30, 7_000_000));
        let config = read(&format!("{REQUIRED}origin = \"52.5,-13.4,75\"")).unwrap();
        let origin = Geodetic { latitude_deg: 52.5, longitude_deg: -13.4, height_m: 75.0 };
        assert_eq!(config.origin, Some(origin));
        let config = read(&format!("{REQUIRED}bind = \"[::]:1883\"")).unwrap();
        assert_eq!(config.bind.unwrap().port(), 1883);
    }

    #[test]
    fn an_error_names_file_line_and_field_and_shows_the_line() {
        for (line, reason) in [
            ("bind = \"localhost:1883\"", "line 3, bind: \"localhost:1883\": write an IP address and a port"),
            ("bind = 1883", "line 3, bind: "),
            ("broker = \"http://h\"", "line 3, broker: broker address \"http://h\": write mqtt://host:port"),
            ("device = \"a b\"", "line 3, device: ' ' in a name"),
            ("tls = { cart = \"c\" }", "line 3, tls: unknown field `cart`"),
            ("broker_memory_bytes = 1_000_000", "line 3, broker_memory_bytes: give at least 16.0 MiB"),
            ("broker_memory = \"1MB\"", "line 3, broker_memory: give at least 16.0 MiB"),
            ("merge_memory = \"1MiB\"", "line 3, merge_memory: give at least 32.0 MiB"),
            ("quorum = 0", "line 3, quorum: give a number from 1 to 16384"),
            ("memory = \"1kB\"", "line 3, memory: give at least 1.00 MiB"),
            ("merge_memory = \"all\"", "line 3, merge_memory: 'all' is not an amount of memory"),
            ("compute = \"cuda\"", "line 3, compute: give auto, cpu, gpu or gpu:N"),
            (
                "clients_max = 16_385",
                "line 3, clients_max: give a number from 1 to 16384; for more, divide the site",
            ),
            ("margin = 1.5", "line 3, margin: give a number from 0 to 1"),
            ("margin = nan", "line 3, margin: give a number from 0 to 1"),
            ("plan = 7", "line 3, plan: "),
            ("uploads_max = 0", "line 3, uploads_max: give a number from 1 to 16384"),
            ("origin = \"52.5,13.4\"", "line 3, origin: "),
            ("bnid = 1", "line 3, bnid: unknown field `bnid`"),
            ("[workers]\nqueue = \"nats://h:1\"", "line 3, workers: missing field `tiles`"),
            ("[upstream]\nsite = \"a b\"", "line 4, upstream.site: ' ' in a name"),
        ] {
            let error = read(&format!("{REQUIRED}{line}\n")).unwrap_err();
            assert!(error.starts_with(reason) && error.lines().count() == 3, "{error:?} is not {reason:?}");
        }
        assert_eq!(read("site = \"s\"\n").unwrap_err(), "missing field `out`");
    }
}
