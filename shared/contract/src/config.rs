//! The configuration of an agent: the content of `agent.toml`.

mod amount;
mod error;
mod range;

use std::num::NonZeroU32;
use std::path::PathBuf;

use cosurf_engine::{DeviceChoice, PoseChoice};
use cosurf_link::serial::DEFAULT_BAUD;
use cosurf_link::{BrokerAddress, TlsFiles};
use cosurf_wire::{DeviceId, FrameId, SiteId};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::Share;

pub use amount::amount;
pub use error::ConfigError;
pub use range::folder;

/// Limit on the agents whose flights count, unless the configuration sets another.
pub const DEFAULT_FLIGHTS_MAX: usize = 256;

/// Number of training steps, unless the configuration sets another.
pub const DEFAULT_STEPS: u32 = 3000;

/// The folder in an agent's `out` that keeps its training. Before it is there, nothing has been learnt.
pub const CHECKPOINT: &str = "checkpoint";

/// The name of an aggregator, unless its configuration sets another. No agent may have it: an aggregator takes no model of
/// its own name.
pub const AGGREGATOR_NAME: &str = "aggregator";

/// The configuration of one agent. Relative paths are relative to the agent's working folder.
///
/// Integers in TOML are signed 64-bit numbers, so `seed` and `memory` can be written as TOML numbers only if they
/// are below 2⁶³.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AgentConfig {
    /// The agent's id: unique on the site, the same in every run. If absent, it is made of the host's name.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub device: Option<DeviceId>,
    /// The site whose aggregator receives the model.
    pub site: SiteId,
    /// The broker's address, for example `mqtt://127.0.0.1:1883`. Give either `broker` or `serial`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub broker: Option<BrokerAddress>,
    /// The certificates for TLS: required if the broker's address starts with `mqtts://` or `wss://`, not allowed if it
    /// starts with `mqtt://`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tls: Option<TlsFiles>,
    /// File of the password for the broker; its user is `device`. If absent, the environment variable
    /// `COSURF_PASSWORD` counts, if it is set. Not allowed with `serial`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub password_file: Option<PathBuf>,
    /// The serial port of a radio whose other end is at the aggregator, for example `/dev/ttyUSB0`. Give either
    /// `broker` or `serial`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub serial: Option<String>,
    /// Speed of the serial port in bits per second; [`DEFAULT_BAUD`] if absent. Not allowed without `serial`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub baud: Option<NonZeroU32>,
    /// The dataset's folder; `data` if absent.
    #[serde(default = "default_data", deserialize_with = "folder")]
    pub data: PathBuf,
    /// The folder to which the agent writes model, checkpoints, report and the received global model; `out` if absent.
    #[serde(default = "default_out", deserialize_with = "folder")]
    pub out: PathBuf,
    /// Names of the views to train on. If `views` and `held_out` are both empty, the agent's cell of the site's plan tells
    /// the views, or all views count if there is no cell. Then `eval_every` tells which of them are held out.
    #[serde(default)]
    pub views: Vec<String>,
    /// Names of the held-out views: scored, never trained on.
    #[serde(default)]
    pub held_out: Vec<String>,
    /// If `views` and `held_out` are both empty, every n-th view of the dataset by sorted name is held out; 0 holds out
    /// none.
    #[serde(default = "default_eval_every")]
    pub eval_every: u32,
    /// Number of training steps, at least 1; [`DEFAULT_STEPS`] if absent.
    #[serde(default = "default_steps", deserialize_with = "range::steps")]
    pub steps: u32,
    /// Seed of all random numbers.
    #[serde(default)]
    pub seed: u64,
    /// `memory`: limit on the process's resident memory, for example `"300MiB"`; a number counts bytes. If absent, the
    /// limit is two thirds of the free memory, at most 8 GiB.
    #[serde(
        rename = "memory",
        alias = "memory_bytes",
        default,
        skip_serializing_if = "Option::is_none",
        deserialize_with = "amount::optional"
    )]
    pub memory_bytes: Option<u64>,
    /// `max_size`: limit on the pictures' long side in pixels, at least 16; larger pictures are shrunk. Full size if
    /// absent.
    #[serde(
        rename = "max_size",
        alias = "max_size_px",
        default,
        skip_serializing_if = "Option::is_none",
        deserialize_with = "range::max_size_px"
    )]
    pub max_size_px: Option<u32>,
    /// The device to train on: `auto` (a hardware GPU if there is one and the memory is enough, otherwise the CPU),
    /// `cpu`, `gpu` or `gpu:N`; `auto` if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub compute: Option<DeviceChoice>,
    /// Number of CPU threads, 1 to 1024; one per core if absent.
    #[serde(default, skip_serializing_if = "Option::is_none", deserialize_with = "range::threads")]
    pub threads: Option<usize>,
    /// Train colour only, without the surface losses.
    #[serde(default)]
    pub color_only: bool,
    /// Share of the splats to prune after two thirds of the steps; 0 prunes none. If absent, the share is the default
    /// of [`cosurf_engine::PruneSettings`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub prune: Option<Share>,
    /// Learn an exposure for each picture, for cameras with automatic exposure.
    #[serde(default)]
    pub exposure: bool,
    /// `poses`: `fixed` takes the poses of the pictures as exact, `learn` corrects them while it trains, `auto` does so if
    /// they turn out not to be exact; `auto` if absent.
    #[serde(default, skip_serializing_if = "is_auto")]
    pub poses: PoseChoice,
    /// A PLY of splats to start from: a model of the ground in the pictures, for example `global.ply` of the last
    /// flight. The word `global` stands for the global model that `out` received earlier. If absent, training starts
    /// from the dataset's sparse points.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub init: Option<PathBuf>,
    /// The world frame of the coordinates; only models of the same frame are merged. If absent, the frame of the site's
    /// plan, or `local` if the aggregator does not answer.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frame: Option<FrameId>,
    /// The file with the secret key that signs the model, written by the command `key`. If absent, the model is not
    /// signed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub key: Option<PathBuf>,
    /// A file with the public keys of the aggregator, one line for each key, as the command `key` prints it. Only global
    /// models and replies that one of these keys has signed count. If absent, all count.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trusted: Option<PathBuf>,
    /// A file like `trusted` with the public keys of the other agents. With `compress`, only flights that one of these
    /// keys has signed count. Needed if both `compress` and `trusted` are set.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fleet: Option<PathBuf>,
    /// True if this model will not be merged with other models. A model that will be merged gets more splats, and keeps
    /// splats that only one view observes.
    #[serde(default)]
    pub alone: bool,
    /// Before the upload, drop the splats of ground that another agent observed better. This halves the upload and
    /// costs the merged model up to 1 dB of PSNR. All agents of a site should use the same value.
    #[serde(default)]
    pub compress: bool,
    /// With `compress`, limit on the agents whose flights count, this one included. Flights of further agents are ignored,
    /// so the ground that they share with this agent may be sent twice.
    #[serde(default = "default_flights_max", deserialize_with = "range::flights_max")]
    pub flights_max: usize,
    /// After the upload, wait for the global model and store it.
    #[serde(default)]
    pub wait_global: bool,
}

/// How an agent reaches its aggregator.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AgentLink<'a> {
    /// Through an MQTT broker.
    Broker {
        /// The broker's address.
        address: &'a BrokerAddress,
        /// The certificates and the key for TLS, if the broker's address starts with `mqtts://` or `wss://`.
        tls: Option<&'a TlsFiles>,
    },
    /// By a radio on a serial port.
    Serial {
        /// The port, for example `/dev/ttyUSB0`.
        port: &'a str,
        /// The port's speed in bits per second.
        baud: NonZeroU32,
    },
}

impl AgentConfig {
    /// Parses the content of an `agent.toml` and checks that its fields fit together. The error names the wrong field
    /// or fields.
    pub fn from_toml(text: &str) -> Result<Self, ConfigError> {
        let config: Self = parse_toml(text)?;
        config.link()?;
        if config.device.is_some_and(|device| device.as_str() == AGGREGATOR_NAME) {
            return Err(ConfigError::NameOfAggregator);
        }
        if config.compress && config.trusted.is_some() && config.fleet.is_none() {
            return Err(ConfigError::NoFleet);
        }
        Ok(config)
    }

    /// How the agent reaches its aggregator. Fails unless exactly one of `broker` and `serial` is set, or if `baud` or
    /// `tls` is set for the other of the two.
    pub fn link(&self) -> Result<AgentLink<'_>, ConfigError> {
        match (&self.broker, &self.serial) {
            (Some(_), None) if self.baud.is_some() => Err(ConfigError::BaudOfBroker),
            (None, Some(_)) if self.tls.is_some() => Err(ConfigError::TlsOfSerial),
            (None, Some(_)) if self.password_file.is_some() => Err(ConfigError::PasswordOfSerial),
            (Some(address), None) => Ok(AgentLink::Broker { address, tls: self.tls.as_ref() }),
            (None, Some(port)) => Ok(AgentLink::Serial { port, baud: self.baud.unwrap_or(DEFAULT_BAUD) }),
            _ => Err(ConfigError::OneLink),
        }
    }
}

/// Parses the content of any configuration file. The error names the line and the field, and shows the line with marks
/// below what is wrong.
pub fn parse_toml<T: DeserializeOwned>(text: &str) -> Result<T, ConfigError> {
    toml::from_str(text).map_err(|error| ConfigError::from_toml(text, &error))
}

fn default_data() -> PathBuf {
    "data".into()
}

fn default_out() -> PathBuf {
    "out".into()
}

fn default_steps() -> u32 {
    DEFAULT_STEPS
}

fn default_eval_every() -> u32 {
    8
}

fn is_auto(poses: &PoseChoice) -> bool {
    *poses == PoseChoice::Auto
}

fn default_flights_max() -> usize {
    DEFAULT_FLIGHTS_MAX
}

#[cfg(test)]
mod tests;
