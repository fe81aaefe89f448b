//! A service that runs until it is stopped: what `cosurf-aggregator run` does with its configuration.

use std::fmt;
use std::fs;
use std::net::SocketAddr;
use std::ops::ControlFlow;
use std::path::Path;
use std::sync::mpsc::Receiver;
use std::time::Duration;

use cosurf_contract::{PasswordError, read_password};
use cosurf_link::mqtt::TlsError;
use cosurf_link::{
    Credentials, Identity, InboxLimits, Login, MqttTransport, Role, SerialConfig, Tls, Trusted, next_session,
};
use cosurf_scene::{FolderLock, SceneError};
use cosurf_wire::{DeviceId, FrameId, SiteId};
use serde::Serialize;

use super::above::AboveLink;
use super::bound::MemoryBound;
use super::config::{AggregatorConfig, TlsConfig, UpstreamConfig, WorkersConfig, WrongTls};
use super::control::{BROKER_ATTEMPTS_MAX, Command, ServiceConfig};
use super::error::ServiceError;
use super::event::ServiceEvent;
use super::folder::senders;
use super::receive::Service;
use super::reporting::{ReportTask, Reporter};
use super::round::{Expected, Rounds};
use super::site_plan::read_plan;
use super::upstream::{Upstream, UpstreamEvent, UpstreamNode};
use crate::broker::{Broker, BrokerError, BrokerEvent, BrokerSettings, Reach, Users, UsersError};
use crate::gateway::{Gateway, GatewayEvent};
use crate::merge::MergeSettings;
use crate::queue::{Queue, QueueError};
use crate::store::{ObjectError, Store};

/// Limit on the number of stored models that the inbox remembers.
const STORED_MAX: usize = 4096;

/// An event of a connection other than that between the service and its broker.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(untagged)]
pub enum SideEvent {
    /// An event of a serial line.
    Line(GatewayEvent),
    /// An event of the connection to the aggregator above.
    Upstream(UpstreamEvent),
    /// An event of the built-in broker.
    Broker(BrokerEvent),
    /// How much memory the service takes at most; told at the start.
    Memory(MemoryBound),
}

impl fmt::Display for SideEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Line(event) => event.fmt(f),
            Self::Upstream(event) => event.fmt(f),
            Self::Broker(event) => event.fmt(f),
            Self::Memory(bound) => bound.fmt(f),
        }
    }
}

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
    /// The built-in broker did not start.
    #[error("bind: {0}")]
    Broker(BrokerError),
    /// The place of the workers' tiles cannot be used.
    #[error("workers.tiles: {0}")]
    Tiles(ObjectError),
    /// The workers' queue cannot be used.
    #[error("workers.queue: {0}")]
    Queue(QueueError),
    /// A key file or the plan could not be read, or the service's folder could not be made or written to.
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

/// What only `main` knows about the machine.
#[derive(Clone, Copy, Debug)]
pub struct Host {
    /// Seconds since 1970 by the machine's clock, for the number of the session. A wrong clock does no harm: in any
    /// case each session's number is greater than the last one's.
    pub clock_s: u64,
    /// Threads to merge with, at least 1.
    pub threads: usize,
    /// Makes the reports.
    pub reporter: Reporter,
}

/// Serves a site and the devices on the serial `lines`, until a command ends it or the sender of `commands` is dropped.
/// `now` returns the time since any fixed moment. `say` gets the events of the service, `say_beside` those of the other
/// connections.
pub fn serve(
    config: &AggregatorConfig,
    host: Host,
    lines: Vec<SerialConfig>,
    now: impl Fn() -> Duration + Clone + Send + 'static,
    commands: &Receiver<Command>,
    mut say: impl FnMut(&ServiceEvent),
    say_beside: impl Fn(SideEvent) + Clone + Send + 'static,
) -> Result<(), ServeError> {
    let _lock = FolderLock::take(&config.out, "cosurf-aggregator run")?;
    let credentials = Credentials::load(
        config.frame.unwrap_or_default(),
        config.key.as_deref(),
        config.trusted.as_deref(),
        None,
    )?;
    let plan = config.plan.as_deref().map(|file| read_plan(file, config.margin)).transpose()?;
    let say_broker = say_beside.clone();
    let (embedded, reach) = reach_broker(config, move |event| say_broker(SideEvent::Broker(event)))?;
    say_beside(SideEvent::Memory(MemoryBound::of(config)));
    let _gateways = start_gateways(config.site, &reach, lines, &say_beside);
    let identity = open_session(config, host.clock_s)?;
    let introduce = embedded.as_ref().map(|broker| introducer(config, broker)).transpose()?;
    let key = credentials.key.clone();
    let mut service =
        Service::open(service_config(config, identity, host.threads))?.with(credentials.clone());
    service = service.with_devices_max(config.devices_max).with_plan(plan.unwrap_or_default());
    let task = ReportTask::new(config.out.clone(), config.site, config.merge_memory_bytes, host.threads);
    service = service.with_reports(host.reporter, task);
    if let Some(workers) = &config.workers {
        service = employ(service, workers, &identity)?;
    }
    let mut upstream = None;
    if let Some(above) = &config.upstream {
        let say = move |event| say_beside(SideEvent::Upstream(event));
        let (started, link) = start_upstream(config, above, identity.session, credentials, now.clone(), say)?;
        service = service.below(link, Duration::from_secs(config.deadline_s));
        upstream = Some(started);
    }
    let mut transport = MqttTransport::start(reach.config(identity, key.as_ref()));
    let mut connections = Connections { upstream, was_connected: false, failure: None };
    service.run(&mut transport, now, commands, |event| {
        say(&event);
        if let (ServiceEvent::Stored { header }, Some(introduce)) = (&event, &introduce) {
            introduce(header.device);
        }
        connections.follow(event)
    });
    connections.failure.map_or(Ok(()), Err)
}

/// The service's connections to the broker and to the aggregator above.
struct Connections {
    upstream: Option<Upstream>,
    /// True once the broker has been reached. If the connection breaks later, it is retried without a limit.
    was_connected: bool,
    failure: Option<ServeError>,
}

impl Connections {
    /// Sends each new revision to the aggregator above. Ends a service whose broker was never reached.
    fn follow(&mut self, event: ServiceEvent) -> ControlFlow<()> {
        match event {
            ServiceEvent::Connected => self.was_connected = true,
            ServiceEvent::Merged { header, .. } => {
                if let Some(upstream) = &self.upstream {
                    upstream.send(header);
                }
            }
            ServiceEvent::Disconnected { attempt, reason }
                if !self.was_connected && attempt >= BROKER_ATTEMPTS_MAX =>
            {
                self.failure = Some(ServeError::NoBroker { reason });
                return ControlFlow::Break(());
            }
            _ => {}
        }
        ControlFlow::Continue(())
    }
}

/// Starts one gateway for each serial line.
fn start_gateways(
    site: SiteId,
    reach: &Reach,
    lines: Vec<SerialConfig>,
    say_beside: &(impl Fn(SideEvent) + Clone + Send + 'static),
) -> Vec<Gateway> {
    let gateway = |line| {
        let say = say_beside.clone();
        let say = move |event| say(SideEvent::Line(event));
        Gateway::start(site, reach.clone(), line, say)
    };
    lines.into_iter().map(gateway).collect()
}

/// Creates the service's folder and draws the number of a new session from the file `session` in it.
fn open_session(config: &AggregatorConfig, clock_s: u64) -> Result<Identity, ServeError> {
    let session = next_session(&config.out.join("session"), clock_s)?;
    Ok(Identity { site: config.site, device: config.device, session, role: Role::Aggregator })
}

fn inbox_limits(config: &AggregatorConfig) -> InboxLimits {
    InboxLimits {
        // So one model, however slowly it arrives, leaves room for others.
        body_bytes_max: config.memory_bytes / 4 * 3,
        total_bytes_max: config.memory_bytes,
        models_max: config.uploads_max,
        stored_max: STORED_MAX,
    }
}

fn service_config(config: &AggregatorConfig, identity: Identity, threads: usize) -> ServiceConfig {
    ServiceConfig {
        identity,
        folder: config.out.clone(),
        limits: inbox_limits(config),
        expected: Expected::Anybody(Rounds {
            quorum: config.quorum,
            quiet: Duration::from_secs(config.quiet_s),
            deadline: Duration::from_secs(config.deadline_s),
        }),
        merge: MergeSettings {
            memory_bytes: config.merge_memory_bytes,
            refine: config.refine,
            vouched: config.frame.is_some_and(|frame| frame != FrameId::default()),
            device: config.compute,
            ..MergeSettings::default()
        },
        threads,
    }
}

/// Lets workers distil the tiles of a service's merges. Services that share a place keep their tiles in folders of their
/// own.
fn employ(service: Service, workers: &WorkersConfig, identity: &Identity) -> Result<Service, ServeError> {
    let tiles = Store::open(&workers.tiles).map_err(ServeError::Tiles)?;
    let queue = Queue::open(&workers.queue).map_err(ServeError::Queue)?;
    let folder = format!("{}.{}", identity.site, identity.device);
    Ok(service.with_workers(tiles.folder(&folder), queue))
}

/// Connects an edge to the aggregator above. Also returns the service's end of the link.
fn start_upstream(
    config: &AggregatorConfig,
    above: &UpstreamConfig,
    session: u64,
    credentials: Credentials,
    now: impl Fn() -> Duration + Send + 'static,
    say: impl Fn(UpstreamEvent) + Send + 'static,
) -> Result<(Upstream, AboveLink), ServeError> {
    let broker = above.broker.clone();
    let tls = Tls::for_broker(&broker, above.tls.as_ref()).map_err(ServeError::UpstreamTls)?;
    let identity = Identity { site: above.site, device: above.device, session, role: Role::Device };
    let trusted = above.trusted.as_deref().map(Trusted::read).transpose()?;
    if credentials.trusted.is_some() && trusted.is_none() {
        return Err(ServeError::UpstreamTrusted);
    }
    let login = login(above.device, above.password_file.as_deref())?;
    let reach = Reach { tls, login, ..Reach::plain(broker) };
    let link_config = reach.config(identity, credentials.key.as_ref());
    let credentials = Credentials { trusted, ..credentials };
    let (node, link) = UpstreamNode::open(identity, credentials, &config.out, inbox_limits(config))
        .map_err(ServiceError::from)?;
    Ok((Upstream::start(node, link_config, now, say), link))
}

/// Tells the built-in broker which devices the service knows: those that sent a model, and those with a trusted key.
/// Returns what tells it of others.
fn introducer(config: &AggregatorConfig, broker: &Broker) -> Result<impl Fn(DeviceId) + use<>, ServeError> {
    let (site, know) = (config.site, broker.introducer());
    let introduce = move |device| {
        know(Identity { site, device, session: 0, role: Role::Device }.client_id());
    };
    senders(&config.out)?.into_iter().for_each(&introduce);
    if let Some(trusted) = &config.trusted {
        let text = fs::read_to_string(trusted).map_err(|cause| SceneError::io(trusted, cause))?;
        // The names before the keys. Lines of revoked keys begin with another word.
        let names = text.lines().filter_map(|line| line.split_whitespace().next());
        names.filter_map(|name| DeviceId::new(name).ok()).for_each(&introduce);
    }
    Ok(introduce)
}

/// Returns how to reach the broker. Starts the built-in broker if the configuration asks for it.
fn reach_broker(
    config: &AggregatorConfig,
    say: impl Fn(BrokerEvent) + Send + 'static,
) -> Result<(Option<Broker>, Reach), ServeError> {
    match (config.bind, &config.broker) {
        (Some(bind), None) => {
            let broker = start_broker(config, bind, say)?;
            let reach = broker.house();
            Ok((Some(broker), reach))
        }
        (None, Some(address)) => {
            if let Some(setting) = config.setting_of_built_in_broker() {
                return Err(ServeError::NotBuiltIn(setting));
            }
            let files = config.tls.as_ref().map(TlsConfig::of_client).transpose()?;
            let tls = Tls::for_broker(address, files.as_ref()).map_err(ServeError::Tls)?;
            let login = login(config.device, config.password_file.as_deref())?;
            let lines = config.line_certs.clone().zip(files.map(|files| files.ca));
            Ok((None, Reach { broker: address.clone(), tls, login, lines }))
        }
        _ => Err(ServeError::OneBroker),
    }
}

/// Starts the built-in broker, unless it would accept everybody on the network unasked.
fn start_broker(
    config: &AggregatorConfig,
    bind: SocketAddr,
    say: impl Fn(BrokerEvent) + Send + 'static,
) -> Result<Broker, ServeError> {
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
    Broker::start_with(bind, settings, say).map_err(ServeError::Broker)
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
}
