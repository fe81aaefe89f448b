//! A service that runs until it is stopped: what `cosurf-aggregator run` does with its configuration.

mod error;
mod reach;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::fs;
use std::ops::ControlFlow;
use std::sync::mpsc::Receiver;
use std::time::Duration;

use cosurf_link::mqtt::HeardStatus;
use cosurf_link::{
    Credentials, Identity, InboxLimits, MqttTransport, Role, SerialConfig, Trusted, next_session,
};
use cosurf_scene::{FolderLock, SceneError};
use cosurf_wire::{DeviceId, FrameId, SiteId};
use serde::Serialize;
use tracing::debug;

use super::above::AboveLink;
use super::bound::MemoryBound;
use super::config::{AggregatorConfig, UpstreamConfig, WorkersConfig};
use super::control::{BROKER_ATTEMPTS_MAX, Command, ServiceConfig};
use super::error::ServiceError;
use super::event::ServiceEvent;
use super::folder::senders;
use super::receive::Service;
use super::reporting::{ReportTask, Reporter};
use super::revoked::revoked;
use super::round::{Expected, Rounds};
use super::site_plan::read_plan;
use super::statuses::DeviceStatus;
use super::upstream::{Upstream, UpstreamEvent, UpstreamNode};
use crate::broker::{Broker, BrokerEvent, Reach, Users};
use crate::gateway::{Gateway, GatewayEvent};
use crate::merge::MergeSettings;
use crate::queue::Queue;
use crate::store::Store;
pub use error::ServeError;
pub use reach::neighbours;
use reach::{reach_above, reach_broker};

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
    /// How far a device is. Told only if [`Host::page_bytes`] is given.
    Status(Box<DeviceStatus>),
}

impl fmt::Display for SideEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Line(event) => event.fmt(f),
            Self::Upstream(event) => event.fmt(f),
            Self::Broker(event) => event.fmt(f),
            Self::Memory(bound) => bound.fmt(f),
            Self::Status(said) => {
                write!(f, "{}: step {} of {}", said.device, said.status.step, said.status.steps)
            }
        }
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
    /// Limit on the memory of a page that shows the service, bytes; `None` without a page. It is part of the memory that
    /// the service tells, and devices' statuses are told for it.
    pub page_bytes: Option<u64>,
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
    // Opened again for each merge; a card that is not there is told now, and not when models have come.
    config.compute.open().map(drop).map_err(|error| ServeError::Compute(config.compute, error))?;
    let plan = config.plan.as_deref().map(|file| read_plan(file, config.margin)).transpose()?;
    let say_broker = say_beside.clone();
    let (embedded, reach) = reach_broker(config, move |event| say_broker(SideEvent::Broker(event)))?;
    say_beside(SideEvent::Memory(MemoryBound::of(config).with_page(host.page_bytes.unwrap_or(0))));
    let _gateways = start_gateways(config.site, &reach, lines, &say_beside);
    let identity = open_session(config, host.clock_s)?;
    let introduce = embedded.as_ref().map(|broker| introducer(config, broker)).transpose()?;
    let shut_out = embedded.as_ref().map(Broker::revoker);
    let key = credentials.key.clone();
    let mut service =
        Service::open(service_config(config, identity, host.threads))?.with(credentials.clone());
    service = service.with_devices_max(config.devices_max).with_plan(plan.unwrap_or_default());
    let task = ReportTask::new(config.out.clone(), config.site, config.merge_memory_bytes, host.threads);
    service = service.with_reports(host.reporter, task);
    if let Some(workers) = &config.workers {
        service = employ(service, workers, &identity)?;
    }
    let link = reach.config(identity, key.as_ref());
    let mut transport = match host.page_bytes {
        None => MqttTransport::start(link),
        Some(_) => MqttTransport::start_hearing(link, say_statuses(say_beside.clone())),
    };
    let mut upstream = None;
    if let Some(above) = &config.upstream {
        let say = move |event| say_beside(SideEvent::Upstream(event));
        let (started, above) =
            start_upstream(config, above, identity.session, credentials, now.clone(), say)?;
        service = service.below(above, Duration::from_secs(config.deadline_s));
        upstream = Some(started);
    }
    if let Some(shut_out) = &shut_out {
        shut_out(revoked(&config.out)?);
    }
    let mut connections = Connections { upstream, was_connected: false, failure: None };
    service.run(&mut transport, now, commands, |event| {
        say(&event);
        if let (ServiceEvent::Stored { header }, Some(introduce)) = (&event, &introduce) {
            introduce(header.device);
        }
        let is_revocation = matches!(event, ServiceEvent::Revoked { .. } | ServiceEvent::Readmitted { .. });
        if let (true, Some(shut_out), Ok(devices)) = (is_revocation, &shut_out, revoked(&config.out)) {
            shut_out(devices);
        }
        connections.follow(event)
    });
    connections.failure.map_or(Ok(()), Err)
}

/// Says how far a device is. Statuses that are not well formed are left out.
fn say_statuses(say: impl Fn(SideEvent)) -> impl Fn(HeardStatus) {
    move |heard| match DeviceStatus::read(&heard) {
        Ok(said) => say(SideEvent::Status(Box::new(said))),
        Err(error) => debug!(device = %heard.device, %error, "ignored a status"),
    }
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
    let identity = Identity { site: above.site, device: above.device, session, role: Role::Device };
    let trusted = above.trusted.as_deref().map(Trusted::read).transpose()?;
    if credentials.trusted.is_some() && trusted.is_none() {
        return Err(ServeError::UpstreamTrusted);
    }
    let link_config = reach_above(above)?.config(identity, credentials.key.as_ref());
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
    trusted_names(config)?.into_iter().for_each(&introduce);
    Ok(introduce)
}

/// The names in the list of trusted keys.
fn trusted_names(config: &AggregatorConfig) -> Result<BTreeSet<DeviceId>, SceneError> {
    let Some(trusted) = &config.trusted else { return Ok(BTreeSet::new()) };
    let text = fs::read_to_string(trusted).map_err(|cause| SceneError::io(trusted, cause))?;
    // The names before the keys. Lines of revoked keys begin with another word.
    let names = text.lines().filter_map(|line| line.split_whitespace().next());
    Ok(names.filter_map(|name| DeviceId::new(name).ok()).collect())
}

/// The devices that a configuration names: in the list of trusted keys, in that of users, and in the plan. Files that cannot be
/// read name nobody; [`serve`] reports them.
pub fn expected_devices(config: &AggregatorConfig) -> BTreeSet<DeviceId> {
    let mut devices = trusted_names(config).unwrap_or_default();
    let users = config.users.as_deref().and_then(|file| Users::read(file).ok());
    devices.extend(users.iter().flat_map(Users::names));
    let plan = config.plan.as_deref().and_then(|file| read_plan(file, config.margin).ok());
    devices.extend(plan.into_iter().flat_map(BTreeMap::into_keys));
    devices
}
