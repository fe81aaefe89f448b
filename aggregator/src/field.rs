//! The receiving service in the field: `aggregator.toml`, and a service that runs until it is stopped.

use std::fmt;
use std::fs;
use std::net::SocketAddr;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::mpsc::Receiver;
use std::time::Duration;

use cosurf_engine::DeviceChoice;
use cosurf_link::mqtt::{BadAddress, TlsError};
use cosurf_link::{
    BrokerAddress, Credentials, Identity, InboxLimits, MqttConfig, MqttTransport, Role, SerialConfig, Tls,
    next_session,
};
use cosurf_scene::{SceneError, TlsFiles};
use cosurf_wire::{DeviceId, FrameId, SiteId};
use serde::{Deserialize, Serialize};

use crate::broker::{Broker, BrokerError};
use crate::gateway::{Gateway, GatewayEvent};
use crate::merge::MergeSettings;
use crate::service::{
    BROKER_ATTEMPTS_MAX, Command, Expected, Rounds, Service, ServiceConfig, ServiceError, ServiceEvent,
};
use crate::upstream::{Ascent, Upstream, UpstreamEvent};

/// Unfinished models at once, and finished ones remembered: far more drones than a site has.
const MODELS_MAX: usize = 256;
const STORED_MAX: usize = 4096;

/// The content of `aggregator.toml`. Relative paths are relative to the working folder.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AggregatorConfig {
    /// The site served.
    pub site: SiteId,
    /// The aggregator's own name on it.
    #[serde(default = "default_device")]
    pub device: String,
    /// Its folder; see [`crate::service`].
    pub out: PathBuf,
    /// Where the embedded broker listens, for example `0.0.0.0:1883`; absent where `broker` is used.
    pub bind: Option<SocketAddr>,
    /// A broker elsewhere, for example `mqtt://10.0.0.2:1883`; absent where `bind` is used.
    pub broker: Option<String>,
    /// Certificates, with a broker of `mqtts://`.
    pub tls: Option<TlsFiles>,
    /// The world frame of the coordinates, the same for all whose models are joined; absent for `local`.
    pub frame: Option<FrameId>,
    /// The secret key to sign with, as the command `key` writes it; absent for no signature.
    pub key: Option<PathBuf>,
    /// The list of those whose models are taken, a line of the command `key` for each; absent for everybody.
    pub trusted: Option<PathBuf>,
    /// Bytes of models that may be on their way in at once.
    #[serde(default = "default_memory_bytes")]
    pub memory_bytes: u64,
    /// Bytes that merging may take.
    #[serde(default = "default_merge_memory_bytes")]
    pub merge_memory_bytes: u64,
    /// What merging computes with: `auto`, `cpu`, `gpu` or `gpu:N`.
    #[serde(default)]
    pub compute: DeviceChoice,
    /// Whether models that lie in another frame than the others are moved to where they fit, rather than kept out.
    #[serde(default)]
    pub refine: bool,
    /// Devices whose models are enough to merge.
    #[serde(default = "default_quorum")]
    pub quorum: usize,
    /// How long no model must have come before a merge, seconds.
    #[serde(default = "default_quiet_s")]
    pub quiet_s: u64,
    /// How long a merge waits at most for more models, seconds.
    #[serde(default = "default_deadline_s")]
    pub deadline_s: u64,
    /// The aggregator above, to which this one is a device: then this one is an edge; see [`crate::upstream`].
    pub upstream: Option<UpstreamConfig>,
}

/// The aggregator above. Frame, key and list of those trusted are the same as below.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UpstreamConfig {
    /// The site that it serves.
    pub site: SiteId,
    /// What this aggregator is called there, unique on that site.
    pub device: DeviceId,
    /// Its broker, for example `mqtt://cloud.example.org:1883`.
    pub broker: String,
    /// Certificates, with a broker of `mqtts://`.
    pub tls: Option<TlsFiles>,
}

/// What happens beside the service.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(untagged)]
pub enum SideEvent {
    /// On serial lines.
    Line(GatewayEvent),
    /// On the way up.
    Upstream(UpstreamEvent),
}

impl fmt::Display for SideEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Line(event) => event.fmt(f),
            Self::Upstream(event) => event.fmt(f),
        }
    }
}

fn default_device() -> String {
    "aggregator".into()
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

impl AggregatorConfig {
    /// Reads a configuration file.
    pub fn read(path: &Path) -> Result<Self, FieldError> {
        let bad = |reason: String| FieldError::Config { path: path.to_path_buf(), reason };
        let text = fs::read_to_string(path).map_err(|error| bad(error.to_string()))?;
        toml::from_str(&text).map_err(|error| bad(error.to_string().trim().replace('\n', " ")))
    }
}

/// Why a service in the field ended.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FieldError {
    /// The configuration cannot be read, or is none.
    #[error("{path}: {reason}")]
    Config {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// Neither or both of `bind` and `broker`.
    #[error("write either bind = \"0.0.0.0:1883\" (a broker of its own) or broker = \"mqtt://host:port\"")]
    OneBroker,
    /// The broker's address is none.
    #[error(transparent)]
    Address(#[from] BadAddress),
    /// Its certificates cannot be used.
    #[error(transparent)]
    Tls(#[from] TlsError),
    /// The aggregator's name is none.
    #[error("device: {0}")]
    Name(#[from] cosurf_wire::IdError),
    /// The embedded broker did not start.
    #[error(transparent)]
    Broker(#[from] BrokerError),
    /// The folder could not be made or written to.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The folder could not be opened.
    #[error(transparent)]
    Service(#[from] ServiceError),
    /// The broker was never reached.
    #[error("{reason}; gave up after {BROKER_ATTEMPTS_MAX} attempts: check `broker` in the configuration")]
    NoBroker {
        /// What the link said last.
        reason: String,
    },
}

/// What only a main knows of the machine.
#[derive(Clone, Copy, Debug)]
pub struct Host {
    /// Seconds since 1970, as far as is known; the session's number is greater than any before whatever it is.
    pub clock_s: u64,
    /// Threads to merge with, at least 1.
    pub threads: usize,
}

/// Serves until `commands` says to end or its sender is gone, devices on serial `lines` too. `say` and
/// `say_beside` show what happens.
pub fn serve(
    config: &AggregatorConfig,
    host: Host,
    lines: Vec<SerialConfig>,
    now: impl Fn() -> Duration + Clone + Send + 'static,
    commands: &Receiver<Command>,
    mut say: impl FnMut(&ServiceEvent),
    say_beside: impl Fn(SideEvent) + Clone + Send + 'static,
) -> Result<(), FieldError> {
    let Host { clock_s, threads } = host;
    let credentials = Credentials::load(
        config.frame.unwrap_or_default(),
        config.key.as_deref(),
        config.trusted.as_deref(),
    )?;
    let (_embedded, broker) = reach_broker(config)?;
    let tls = Tls::for_broker(&broker, config.tls.as_ref())?;
    let gateway = |line| {
        let say = say_beside.clone();
        let say = move |event| say(SideEvent::Line(event));
        Gateway::start(config.site, broker.clone(), tls.clone(), line, say)
    };
    let _gateways: Vec<Gateway> = lines.into_iter().map(gateway).collect();
    let device = DeviceId::new(&config.device)?;
    let out = &config.out;
    fs::create_dir_all(out).map_err(|cause| SceneError::io(out, cause))?;
    let session = next_session(&out.join("session"), clock_s)?;
    let identity = Identity { site: config.site, device, session, role: Role::Aggregator };
    let limits = InboxLimits {
        body_bytes_max: config.memory_bytes,
        total_bytes_max: config.memory_bytes,
        models_max: MODELS_MAX,
        stored_max: STORED_MAX,
    };
    let service = Service::open(ServiceConfig {
        identity,
        folder: config.out.clone(),
        limits,
        expected: Expected::Anybody(Rounds {
            quorum: config.quorum,
            quiet: Duration::from_secs(config.quiet_s),
            deadline: Duration::from_secs(config.deadline_s),
        }),
        merge: MergeSettings {
            memory_bytes: config.merge_memory_bytes,
            refine: config.refine,
            device: config.compute,
            ..MergeSettings::default()
        },
        threads,
    })?
    .with(credentials.clone());
    let upstream = config.upstream.as_ref().map(|above| {
        let say = move |event| say_beside(SideEvent::Upstream(event));
        climb(above, session, credentials, out, limits, now.clone(), say)
    });
    let upstream = upstream.transpose()?;
    let mut transport = MqttTransport::start(MqttConfig { broker, identity, tls });
    let (mut connected, mut outcome) = (false, Ok(()));
    service.run(&mut transport, now, commands, |event| {
        say(&event);
        match event {
            ServiceEvent::Connected => connected = true,
            ServiceEvent::Merged { header, .. } => {
                if let Some(upstream) = &upstream {
                    upstream.send(header);
                }
            }
            ServiceEvent::Disconnected { attempt, reason }
                if !connected && attempt >= BROKER_ATTEMPTS_MAX =>
            {
                outcome = Err(FieldError::NoBroker { reason });
                return ControlFlow::Break(());
            }
            _ => {}
        }
        ControlFlow::Continue(())
    });
    outcome
}

/// Starts the way up of the service with the folder `out`.
fn climb(
    above: &UpstreamConfig,
    session: u64,
    credentials: Credentials,
    out: &Path,
    limits: InboxLimits,
    now: impl Fn() -> Duration + Send + 'static,
    say: impl Fn(UpstreamEvent) + Send + 'static,
) -> Result<Upstream, FieldError> {
    let broker: BrokerAddress = above.broker.parse()?;
    let tls = Tls::for_broker(&broker, above.tls.as_ref())?;
    let identity = Identity { site: above.site, device: above.device, session, role: Role::Device };
    let ascent = Ascent::open(identity, credentials, out, limits).map_err(ServiceError::from)?;
    Ok(Upstream::start(ascent, MqttConfig { broker, identity, tls }, now, say))
}

fn reach_broker(config: &AggregatorConfig) -> Result<(Option<Broker>, BrokerAddress), FieldError> {
    match (config.bind, &config.broker) {
        (Some(bind), None) => {
            let broker = Broker::start(bind)?;
            let address = local_address(broker.address());
            Ok((Some(broker), address))
        }
        (None, Some(text)) => Ok((None, text.parse()?)),
        _ => Err(FieldError::OneBroker),
    }
}

/// How this machine reaches a broker of its own: one that listens everywhere, by loopback.
pub(crate) fn local_address(listening: SocketAddr) -> BrokerAddress {
    let ip = match listening.ip() {
        ip if !ip.is_unspecified() => ip,
        std::net::IpAddr::V4(_) => std::net::Ipv4Addr::LOCALHOST.into(),
        std::net::IpAddr::V6(_) => std::net::Ipv6Addr::LOCALHOST.into(),
    };
    BrokerAddress { host: ip.to_string(), port: listening.port(), is_tls: false }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_broker_that_listens_everywhere_is_reached_here() {
        for (listening, host) in
            [("0.0.0.0:7", "127.0.0.1"), ("[::]:7", "::1"), ("192.168.0.9:7", "192.168.0.9")]
        {
            let address = local_address(listening.parse().unwrap());
            assert_eq!((address.host.as_str(), address.port), (host, 7));
        }
    }

    #[test]
    fn one_broker_is_needed_and_one_only() {
        let base = "site = \"s\"\nout = \"o\"\n";
        for brokers in ["", "bind = \"0.0.0.0:0\"\nbroker = \"mqtt://h:1\"\n"] {
            let config: AggregatorConfig = toml::from_str(&format!("{base}{brokers}")).unwrap();
            assert!(matches!(reach_broker(&config), Err(FieldError::OneBroker)), "{brokers}");
        }
        assert!(toml::from_str::<AggregatorConfig>(&format!("{base}bnid = 1")).is_err());
        let refused = toml::from_str::<AggregatorConfig>(&format!("{base}compute = \"cuda\"")).unwrap_err();
        assert!(refused.to_string().contains("auto, cpu, gpu or gpu:N"), "{refused}");
        assert!(toml::from_str::<AggregatorConfig>("site = \"a b\"\nout = \"o\"").is_err());
    }
}
