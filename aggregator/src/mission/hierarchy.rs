//! The aggregators of a mission, all on this machine: the root and, if there are any, the edges below it. Each
//! aggregator serves its own site from its own folder, on its own thread. An edge has a second thread for its link to
//! the root. Aggregators are numbered by *posts*: post 0 is the root, and post `1 + i` is edge `i`.

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::mpsc::Sender;
use std::time::Duration;

use cosurf_link::{Credentials, Identity, InboxLimits, Role};
use cosurf_wire::{DeviceId, ModelHeader, SiteId};

use super::error::MissionError;
use super::order::{MissionOrder, Surroundings};
use super::plan::{Edge, Plan};
use super::signal::Signal;
use crate::broker::Reach;
use crate::service::{
    AboveLink, Expected, Service, ServiceConfig, ServiceError, Station, Upstream, UpstreamNode,
};

/// Limit on the bytes of all concurrent uploads to an aggregator; further uploads wait. A single larger model is
/// refused.
const INBOX_BYTES_MAX: u64 = 1 << 30;
/// Longest time that the agents of an edge wait for the root's global model before they get the edge's.
const ROOT_WAIT: Duration = Duration::from_secs(3600);
/// Number of models from the root that an edge remembers. The root's model may come in many tiles.
const FROM_ROOT_MAX: usize = 4096;

/// The folder of an edge inside `out`, the folder of the mission.
pub(crate) fn edge_folder(out: &Path, edge: &Edge) -> PathBuf {
    out.join("edges").join(edge.device.as_str())
}

/// The folders of the aggregators to which the agents send their models.
pub(crate) fn lowest_folders(out: &Path, plan: &Plan) -> Vec<PathBuf> {
    match plan.edges.is_empty() {
        true => vec![out.to_path_buf()],
        false => plan.edges.iter().map(|edge| edge_folder(out, edge)).collect(),
    }
}

/// The running aggregators. Dropping this value ends them.
pub(crate) struct Hierarchy {
    /// The root aggregator.
    top: Station,
    edges: Vec<RunningEdge>,
}

/// A running edge.
struct RunningEdge {
    device: DeviceId,
    /// Indices of the edge's agents.
    agents: Range<usize>,
    /// The service for the edge's agents; `None` once the edge has made its last revision.
    station: Option<Station>,
    upstream: Upstream,
}

impl Hierarchy {
    /// Opens the folder of every aggregator and starts to serve. All aggregators use the broker that `reach` names, and
    /// send their events to `say`.
    pub(crate) fn start(
        order: &MissionOrder,
        around: &Surroundings,
        plan: &Plan,
        reach: &Reach,
        say: &Sender<Signal>,
    ) -> Result<Self, MissionError> {
        let aggregator = DeviceId::new("aggregator")?;
        let serve = |post, site: SiteId, folder: PathBuf, below: Vec<DeviceId>, root: Option<AboveLink>| {
            let identity =
                Identity { site, device: aggregator, session: around.session, role: Role::Aggregator };
            let mut service = Service::open(service_config(order, identity, folder, below, around.cores))?;
            if let Some(root) = root {
                service = service.below(root, ROOT_WAIT);
            }
            let tell = say.clone();
            let tell = move |event| {
                let _ = tell.send(Signal::Service { post, event }); // fails only after the end of the mission
            };
            Ok::<Station, ServiceError>(Station::start(
                service,
                reach.config(identity, None),
                around.now.clone(),
                tell,
            ))
        };
        let start_edge = |(i, edge): (usize, &Edge)| {
            let folder = edge_folder(&order.out, edge);
            let (upstream, root) = start_upstream(i, edge, &folder, plan, around, reach, say)?;
            let agents = plan.devices[edge.agents.clone()].to_vec();
            let station = Some(serve(1 + i, edge.site, folder, agents, Some(root))?);
            Ok::<RunningEdge, ServiceError>(RunningEdge {
                device: edge.device,
                agents: edge.agents.clone(),
                station,
                upstream,
            })
        };
        let below = match plan.edges.is_empty() {
            true => plan.devices.clone(),
            false => plan.edges.iter().map(|edge| edge.device).collect(),
        };
        Ok(Self {
            top: serve(0, plan.site, order.out.clone(), below, None)?,
            edges: plan.edges.iter().enumerate().map(start_edge).collect::<Result<_, _>>()?,
        })
    }

    /// Whether an aggregator ended without being asked to.
    pub(crate) fn has_died(&self) -> bool {
        self.edges.iter().filter_map(|edge| edge.station.as_ref()).chain([&self.top]).any(Station::has_died)
    }

    /// Tells the aggregator of an agent not to wait for this agent any longer.
    pub(crate) fn give_up(&self, agent: usize, device: DeviceId) {
        match self.edges.iter().find(|edge| edge.agents.contains(&agent)) {
            Some(RunningEdge { station: Some(station), .. }) => station.give_up(device),
            Some(_) => {}
            None => self.top.give_up(device),
        }
    }

    /// Tells the root not to wait for the model of the edge at `post` any longer; does nothing if `post` is the root. The
    /// agents of the other edges wait for the root's model.
    pub(crate) fn give_up_edge(&self, post: usize) {
        if let Some(edge) = post.checked_sub(1).and_then(|edge| self.edges.get(edge)) {
            self.top.give_up(edge.device);
        }
    }

    /// Sends a revision from the edge at `post` to the root; does nothing if `post` is the root.
    pub(crate) fn send_up(&self, post: usize, revision: ModelHeader) {
        if let Some(edge) = post.checked_sub(1).and_then(|edge| self.edges.get(edge)) {
            edge.upstream.send(revision);
        }
    }

    /// Lets every edge finish a merge that is due and then stop serving. The edges' links to the root stay open.
    /// Returns for each edge whether it has a model. The root no longer waits for edges without a model.
    pub(crate) fn close_edges(&mut self) -> Vec<bool> {
        let close = |edge: &mut RunningEdge| {
            let has_model = edge.station.take().and_then(Station::finish).is_some();
            if !has_model {
                self.top.give_up(edge.device);
            }
            has_model
        };
        self.edges.iter_mut().map(close).collect()
    }

    /// Lets the root finish a merge that is due, then ends all aggregators. Returns the header of the newest global
    /// model; `None` if there is none.
    pub(crate) fn finish(self) -> Option<ModelHeader> {
        let global = self.top.finish();
        drop(self.edges);
        global
    }
}

fn service_config(
    order: &MissionOrder,
    identity: Identity,
    folder: PathBuf,
    below: Vec<DeviceId>,
    threads: usize,
) -> ServiceConfig {
    ServiceConfig {
        identity,
        folder,
        limits: limits(below.len()),
        expected: Expected::Devices(below.into_iter().collect()),
        merge: order.settings.merge,
        threads,
    }
}

/// Limits of an inbox that receives models from `devices` senders.
fn limits(devices: usize) -> InboxLimits {
    InboxLimits {
        body_bytes_max: INBOX_BYTES_MAX,
        total_bytes_max: INBOX_BYTES_MAX,
        models_max: devices,
        stored_max: 2 * devices,
    }
}

/// Starts the upstream link of edge `i`. Also returns its service's end of the link.
fn start_upstream(
    i: usize,
    edge: &Edge,
    folder: &Path,
    plan: &Plan,
    around: &Surroundings,
    reach: &Reach,
    say: &Sender<Signal>,
) -> Result<(Upstream, AboveLink), ServiceError> {
    let identity =
        Identity { site: plan.site, device: edge.device, session: around.session, role: Role::Device };
    let limits = InboxLimits { stored_max: FROM_ROOT_MAX, ..limits(1) };
    let (node, root) = UpstreamNode::open(identity, Credentials::default(), folder, limits)?;
    let link = reach.config(identity, None);
    let (now, tell) = (around.now.clone(), say.clone());
    let tell = move |event| {
        let _ = tell.send(Signal::Upstream { edge: i, event }); // fails only after the end of the mission
    };
    Ok((Upstream::start(node, link, move || now(), tell), root))
}
