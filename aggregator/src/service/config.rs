//! `aggregator.toml`: the configuration of a service on the ground station.

use std::fs;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use cosurf_engine::DeviceChoice;
use cosurf_link::{BrokerAddress, TlsFiles};
use cosurf_wire::{DeviceId, FrameId, SiteId};
use serde::Deserialize;

use super::round::Rounds;
use crate::merge::MergeSettings;

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
    pub out: PathBuf,
    /// Address on which the embedded broker listens, for example `0.0.0.0:1883`; absent where `broker` is used.
    pub bind: Option<SocketAddr>,
    /// URL of another broker, for example `mqtt://10.0.0.2:1883`; absent where `bind` is used.
    pub broker: Option<BrokerAddress>,
    /// Certificates for a broker with `mqtts://`.
    pub tls: Option<TlsFiles>,
    /// World frame of the coordinates, the same for all models that are merged; absent for `local`.
    pub frame: Option<FrameId>,
    /// File of the secret key that signs the global model, written by the command `key`; absent for no signature.
    pub key: Option<PathBuf>,
    /// List of public keys whose models are accepted, one line of the command `key` each; absent to accept all.
    pub trusted: Option<PathBuf>,
    /// Limit on the bytes of concurrent uploads; further agents wait.
    #[serde(default = "default_memory_bytes")]
    pub memory_bytes: u64,
    /// Limit on the bytes that merging takes.
    #[serde(default = "default_merge_memory_bytes")]
    pub merge_memory_bytes: u64,
    /// Device that merging computes on: `auto`, `cpu`, `gpu` or `gpu:N`.
    #[serde(default)]
    pub compute: DeviceChoice,
    /// True to move a model that lies in another frame than the others to where it fits, instead of leaving it out.
    #[serde(default)]
    pub refine: bool,
    /// Number of devices whose models are enough to merge.
    #[serde(default = "default_quorum")]
    pub quorum: usize,
    /// Seconds without a new model before a merge begins.
    #[serde(default = "default_quiet_s")]
    pub quiet_s: u64,
    /// Seconds that a merge waits for more models at most.
    #[serde(default = "default_deadline_s")]
    pub deadline_s: u64,
    /// The aggregator above. Where it is set, this aggregator is an edge: a device of the one above.
    pub upstream: Option<UpstreamConfig>,
}

/// The aggregator above an edge. World frame, key and trusted keys are those of the edge's own site.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UpstreamConfig {
    /// The site that it serves.
    pub site: SiteId,
    /// Device id of the edge on that site, unique there.
    pub device: DeviceId,
    /// URL of its broker, for example `mqtt://cloud.example.org:1883`.
    pub broker: BrokerAddress,
    /// Certificates for a broker with `mqtts://`.
    pub tls: Option<TlsFiles>,
}

fn default_device() -> DeviceId {
    DeviceId::new("aggregator").expect("the name is valid")
}

fn default_memory_bytes() -> u64 {
    1 << 30
}

fn default_merge_memory_bytes() -> u64 {
    MergeSettings::default().memory_bytes
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

/// The configuration file cannot be read or parsed.
#[derive(Debug, thiserror::Error)]
#[error("{path}: {reason}")]
pub struct ConfigError {
    /// The file.
    pub path: PathBuf,
    /// What is wrong, one line.
    pub reason: String,
}

impl AggregatorConfig {
    /// Reads a configuration file.
    pub fn read(path: &Path) -> Result<Self, ConfigError> {
        let bad = |reason: String| ConfigError { path: path.to_path_buf(), reason };
        let text = fs::read_to_string(path).map_err(|error| bad(error.to_string()))?;
        toml::from_str(&text).map_err(|error| bad(error.to_string().trim().replace('\n', " ")))
    }
}
