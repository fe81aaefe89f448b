//! A hierarchy on one thread, over a faulty network: a cloud, two edges below it, and three drones below the
//! edges.
#![allow(clippy::unwrap_used)]

use std::ops::ControlFlow;
use std::sync::mpsc;

use cosurf_link::{FirstLayer, MemoryNetwork, MemoryTransport, Model, Role, model_to_body, plain_importance};
use cosurf_wire::{BodyHash, ModelId};

use cosurf_link::body_to_model;
use cosurf_scene::{LocalFrame, ply};

use super::*;
use crate::gate::{Workspace, admit};
use crate::merge::InMemory;
use crate::merge::{MergeSettings, Resources, Tiles, merge};
use crate::service::pack::packed;
use crate::service::{Expected, Service, ServiceConfig, ServiceEvent};
use crate::testing::{BAD_WEATHER, LIMITS, PATIENCE, QUICK, identity, model_at};

const SETTINGS: MergeSettings = MergeSettings { seed: 3, ..QUICK };

/// The body of a model, as a drone sends it.
fn sent(Model { splats, cameras }: &Model) -> Vec<u8> {
    model_to_body(splats, cameras, &LocalFrame::WORLD, FirstLayer::ByImportance(&plain_importance(splats)))
        .unwrap()
}

/// The body of the model that a merge of the models in `bodies` gives.
fn merged(bodies: &[Vec<u8>]) -> Vec<u8> {
    let locals =
        InMemory(bodies.iter().map(|body| body_to_model(body, &LocalFrame::WORLD).unwrap()).collect());
    let admitted =
        admit(&locals, (&SETTINGS).into(), Workspace::of(&SETTINGS, &std::env::temp_dir(), 1), &|| false)
            .unwrap();
    let merged = merge(
        &admitted,
        &SETTINGS,
        Resources { scratch: tempfile::tempdir().unwrap().path(), tiles: Tiles::Forgotten, threads: 1 },
        &mut |_| ControlFlow::Continue(()),
    )
    .unwrap();
    packed(&merged.model, &LocalFrame::WORLD, 1, &|| false).unwrap()
}

/// An aggregator: its service, its connection to the network, and for an edge its upstream link.
struct Level {
    service: Service,
    transport: MemoryTransport,
    above: Option<(UpstreamNode, MemoryTransport)>,
    has_come_down: bool,
}

impl Level {
    fn open(network: &MemoryNetwork, folder: &Path, site: &str, below: &[&str], is_edge: bool) -> Self {
        let (ground, device) =
            (identity(site, "aggregator", Role::Aggregator), identity("cloud", site, Role::Device));
        let mut service = Service::open(ServiceConfig {
            identity: ground,
            folder: folder.into(),
            limits: LIMITS,
            expected: Expected::Devices(below.iter().map(|name| DeviceId::new(name).unwrap()).collect()),
            merge: SETTINGS,
            threads: 1,
        })
        .unwrap();
        let above =
            is_edge.then(|| UpstreamNode::open(device, Credentials::default(), folder, LIMITS).unwrap());
        let above = above.map(|(node, link)| {
            service.keeper.follow(link, PATIENCE);
            (node, network.join(&device))
        });
        Self { service, transport: network.join(&ground), above, has_come_down: false }
    }

    fn step(&mut self, now: Duration) {
        let mut revision = None;
        let _ = self.service.step(
            &mut self.transport,
            || now,
            Duration::ZERO,
            |event| {
                if let ServiceEvent::Merged { header, .. } = event {
                    revision = Some(header);
                }
                ControlFlow::Continue(())
            },
        );
        let Some((node, transport)) = &mut self.above else { return };
        if let Some(revision) = revision {
            node.send(&revision).unwrap();
        }
        let event = node.step(transport, || now, Duration::ZERO);
        self.has_come_down |= matches!(event, Some(UpstreamEvent::CameDown { .. }));
    }
}

/// A drone that sends its model.
struct Drone(Node, MemoryTransport);

impl Drone {
    fn new(network: &MemoryNetwork, site: &str, name: &str, model: &Model) -> Self {
        let identity = identity(site, name, Role::Device);
        let mut node = Node::new(identity, LIMITS, &[]);
        let offer = Offer::from_body(identity.device, ModelId(1), ModelKind::Local, 2, sent(model));
        node.upload(offer.unwrap());
        Self(node, network.join(&identity))
    }

    fn step(&mut self, now: Duration) {
        if let Some(NodeEvent::Store { header, .. }) = self.0.step(&mut self.1, || now, Duration::ZERO) {
            self.0.stored(header.into());
        }
    }
}

fn tree(network: &MemoryNetwork, folder: &Path) -> [Level; 3] {
    let level = |site, below: &[&str]| Level::open(network, &folder.join(site), site, below, site != "cloud");
    [level("cloud", &["edge-1", "edge-2"]), level("edge-1", &["a", "b"]), level("edge-2", &["c"])]
}

/// Runs until both edges have received the cloud's global model. Returns the hash of the newest one that each
/// edge has stored.
fn run(network: &MemoryNetwork, folder: &Path, drones: &mut [Drone]) -> [BodyHash; 2] {
    let mut levels = tree(network, folder);
    while !levels[1..].iter().all(|level| level.has_come_down) {
        let now = network.now();
        assert!(now < PATIENCE, "no global model came from the cloud");
        drones.iter_mut().for_each(|drone| drone.step(now));
        levels.iter_mut().for_each(|level| level.step(now));
        match levels.iter().any(|level| level.service.is_merging()) {
            true => std::thread::sleep(Duration::from_micros(200)),
            false => network.advance(now + Duration::from_millis(5)),
        }
    }
    ["edge-1", "edge-2"].map(|edge| {
        let (_, headers) = ModelStore::open(&folder.join(edge).join("upstream/global")).unwrap();
        headers.last().unwrap().blake3
    })
}

#[test]
fn the_cloud_merges_its_edges_models_and_both_edges_receive_the_result() {
    let folder = tempfile::tempdir().unwrap();
    let models = [-2.0, 0.0, 2.0].map(model_at);
    let drones = models.each_ref().map(sent);
    let of_all = merged(&[merged(&drones[..2]), merged(&drones[2..])]);
    let of_all = Offer::from_body(DeviceId::new("any").unwrap(), ModelId(1), ModelKind::Global, 2, of_all);
    let expected = of_all.unwrap().header.blake3;

    let network = MemoryNetwork::new(1, BAD_WEATHER);
    let drones = [("edge-1", "a"), ("edge-1", "b"), ("edge-2", "c")].into_iter().zip(&models);
    let mut drones: Vec<Drone> =
        drones.map(|((site, name), model)| Drone::new(&network, site, name, model)).collect();
    assert_eq!(run(&network, folder.path(), &mut drones), [expected; 2]);
    let splats = |file| ply::read(&folder.path().join(file), &LocalFrame::WORLD).unwrap().len();
    assert_eq!(splats("edge-2/upstream/global.ply"), splats("cloud/global.ply"));

    // All aggregators are killed and restarted. The drones do not take part again: the models on the aggregators'
    // disks suffice.
    let network = MemoryNetwork::new(2, BAD_WEATHER);
    assert_eq!(run(&network, folder.path(), &mut []), [expected; 2]);
}

#[test]
fn the_thread_ends_although_the_aggregator_above_is_unreachable() {
    let folder = tempfile::tempdir().unwrap();
    let identity = identity("cloud", "edge-1", Role::Device);
    let (node, _link) = UpstreamNode::open(identity, Credentials::default(), folder.path(), LIMITS).unwrap();
    let (say, events) = mpsc::channel();
    let broker = "mqtt://127.0.0.1:1".parse().unwrap();
    let begun = std::time::Instant::now();
    let link = MqttConfig { broker, identity, will: None, tls: None, login: None };
    let upstream =
        Upstream::start(node, link, move || begun.elapsed(), move |event| say.send(event).unwrap());
    let first = events.recv_timeout(PATIENCE).unwrap();
    assert!(matches!(first, UpstreamEvent::UpstreamDisconnected { attempt: 1, .. }), "{first}");
    drop(upstream);
}
