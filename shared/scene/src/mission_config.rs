//! What an agent is told to do: the content of `agent.toml`. A person writes it for a drone in the
//! field; the aggregator's `mission` writes one for each agent that it starts. It lives here since
//! agent and aggregator never see each other.

use std::num::NonZeroU32;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

/// The orders of one agent. Relative paths are relative to the agent's working folder.
///
/// TOML's integers are signed: `seed` and `memory_bytes` must be below 2⁶³ to be written as TOML.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AgentConfig {
    /// The agent's own id, unique on the site, stable from run to run: 1 to 32 characters of
    /// `A-Z a-z 0-9 _ -`.
    pub device: String,
    /// The site whose aggregator gets the model; same alphabet.
    pub site: String,
    /// The broker's address, for example `mqtt://127.0.0.1:1883`; absent where `serial` is used.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub broker: Option<String>,
    /// Certificates, with a broker of `mqtts://`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tls: Option<TlsFiles>,
    /// The serial port of a radio whose other end is the aggregator's, for example `/dev/ttyUSB0`; absent
    /// where `broker` is used.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub serial: Option<String>,
    /// Speed of the serial port in bits per second; absent for 57,600.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub baud: Option<NonZeroU32>,
    /// The dataset's folder.
    pub data: PathBuf,
    /// Where model, checkpoints, report and the received global model go.
    pub out: PathBuf,
    /// Names of the views to train on. Where both lists are empty, the dataset is split by
    /// `eval_every`.
    #[serde(default)]
    pub views: Vec<String>,
    /// Names of the views held out, to be scored and never trained on.
    #[serde(default)]
    pub held_out: Vec<String>,
    /// With no lists given, every n-th view by sorted name is held out; 0 holds out none.
    #[serde(default = "default_eval_every")]
    pub eval_every: u32,
    /// Training steps.
    pub steps: u32,
    /// Seed of every random choice.
    #[serde(default)]
    pub seed: u64,
    /// The most resident memory that the process may take; absent for as much as it likes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub memory_bytes: Option<u64>,
    /// Pictures are shrunk until their long side is at most this many pixels; absent for full size.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_size_px: Option<u32>,
    /// What computes: `auto` (a real graphics card if there is one), `cpu`, `gpu`, `gpu:N`; absent for `auto`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub compute: Option<String>,
    /// Threads to compute with, at least 1; absent for one per core.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub threads: Option<usize>,
    /// Train colours only, without the losses of the surface.
    #[serde(default)]
    pub color_only: bool,
    /// Share of the splats to remove after two thirds of the steps, 0 for none; absent for the usual share.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub prune: Option<f64>,
    /// Learn an exposure for each photograph, for cameras that choose their own.
    #[serde(default)]
    pub exposure: bool,
    /// A model of the same ground to begin with, for example the last flight's `global.ply`; `global` for the global
    /// model that came back to `out`, once there is one; absent to begin with the sparse cloud.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub init: Option<PathBuf>,
    /// The world frame of the coordinates, the same for all whose models are joined; absent for `local`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frame: Option<String>,
    /// The secret key to sign with, as the command `key` writes it; absent for no signature.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub key: Option<PathBuf>,
    /// The list of those whose models are taken, a line of the command `key` for each; absent for everybody.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trusted: Option<PathBuf>,
    /// Whether nobody else's model will be joined with this one. Models that will be are trained with more splats, and
    /// keep ground that a single view observes.
    #[serde(default)]
    pub alone: bool,
    /// Whether to leave ground that other agents show as well to its owner before the upload: half the bytes, for a
    /// slow link, and a merged model that is some tenths of a dB worse. All agents of the site should do the same.
    #[serde(default)]
    pub compress: bool,
    /// Whether to wait, after the upload, for the global model and keep it.
    #[serde(default)]
    pub wait_global: bool,
}

/// Certificates of a client that speaks TLS, in PEM.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TlsFiles {
    /// Whom to trust: certificates of authorities.
    pub ca: PathBuf,
    /// The client's own certificate, and those between it and the authority.
    pub cert: PathBuf,
    /// The private key of it.
    pub key: PathBuf,
}

fn default_eval_every() -> u32 {
    8
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn only_the_necessary_must_be_written() {
        let json = r#"{"device":"d","site":"s","broker":"b","data":"in","out":"out","steps":7}"#;
        let config: AgentConfig = serde_json::from_str(json).unwrap();
        assert_eq!((config.steps, config.eval_every, config.seed), (7, 8, 0));
        assert!(
            config.views.is_empty() && config.memory_bytes.is_none() && !config.alone && !config.wait_global
        );
        let again: AgentConfig = serde_json::from_str(&serde_json::to_string(&config).unwrap()).unwrap();
        assert_eq!(config, again);
    }

    #[test]
    fn a_misspelt_field_is_refused() {
        let json = r#"{"device":"d","site":"s","broker":"b","data":"in","out":"o","steps":7,"step":1}"#;
        let error = serde_json::from_str::<AgentConfig>(json).unwrap_err().to_string();
        assert!(error.contains("step"), "{error}");
    }
}
