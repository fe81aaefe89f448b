//! Runs a service and its drones on one thread, over a simulated network that loses, duplicates, corrupts and
//! delays messages.
#![allow(clippy::unwrap_used)]

mod attacks;
#[cfg(unix)]
mod damage;
mod doubt;
mod far;
mod flights;
mod hierarchy;
mod life;
mod lost;
mod parts;
mod places;
mod plan;
mod reports;
mod restoring;
mod tiles;
mod withdrawal;
mod workers;

use std::fs;
use std::ops::ControlFlow;
use std::path::Path;
use std::sync::mpsc;
use std::time::Duration;

use cosurf_link::{Faults, Identity, MemoryNetwork, MemoryTransport, Node, Role, body_to_model};

use cosurf_link::{Model, ModelKey, NodeEvent, Offer};
use cosurf_scene::{LocalFrame, ply};
use cosurf_wire::{DeviceId, ModelHeader, ModelId, ModelKind, Topic};

use super::keeper::RunState;
use super::pack::packed;
use super::*;
use crate::merge::MergeSettings;
use crate::testing::model;
use crate::testing::{self, BAD_WEATHER, LIMITS, PATIENCE};

const AT_ONCE: Rounds = Rounds { quorum: 1, quiet: Duration::ZERO, deadline: Duration::ZERO };

fn identity(name: &str, role: Role) -> Identity {
    testing::identity("test", name, role)
}

/// A drone that sends one model and stores the global model.
struct Drone {
    node: Node,
    transport: MemoryTransport,
    global: Option<ModelHeader>,
}

impl Drone {
    fn new(network: &MemoryNetwork, name: &str, number: u64, model: &Model) -> Self {
        let identity = identity(name, Role::Device);
        let mut node = Node::new(identity, LIMITS, &[]);
        let Model { splats, cameras } = model;
        let offer = Offer::new(identity.device, ModelId(number), ModelKind::Local, 3, splats, cameras);
        node.upload(offer.unwrap());
        Self { node, transport: network.join(&identity), global: None }
    }

    /// A drone whose model lies in a frame of its own.
    fn without_place(network: &MemoryNetwork, name: &str, number: u64, model: &Model) -> Self {
        let identity = identity(name, Role::Device);
        let mut node = Node::new(identity, LIMITS, &[]);
        let Model { splats, cameras } = model;
        let offer = Offer::new(identity.device, ModelId(number), ModelKind::Local, 3, splats, cameras);
        node.upload(offer.unwrap().without_place());
        Self { node, transport: network.join(&identity), global: None }
    }

    /// A drone with a model that is encoded already.
    fn with_body(network: &MemoryNetwork, name: &str, number: u64, body: Vec<u8>) -> Self {
        let identity = identity(name, Role::Device);
        let mut node = Node::new(identity, LIMITS, &[]);
        node.upload(Offer::from_body(identity.device, ModelId(number), ModelKind::Local, 3, body).unwrap());
        Self { node, transport: network.join(&identity), global: None }
    }

    fn step(&mut self, now: Duration) {
        let event = self.node.step(&mut self.transport, || now, Duration::ZERO);
        match event {
            Some(NodeEvent::Store { header, .. }) => {
                self.node.stored(ModelKey { device: header.device, model: header.model });
                self.global = Some(header);
            }
            Some(NodeEvent::Known(header)) => self.global = Some(header),
            _ => {}
        }
    }
}

/// The first `count` of three drones. A drone that has joined must be stepped until the test ends, because
/// virtual time stands still while a message waits for its receiver.
fn drones(network: &MemoryNetwork, count: usize) -> Vec<Drone> {
    let models =
        [("agent-1", model(900, 1, 1.0)), ("agent-2", model(700, 0, 2.0)), ("agent-3", model(2, 1, 3.0))];
    models.iter().take(count).map(|(name, model)| Drone::new(network, name, 1, model)).collect()
}

/// A service and its connection to the network.
struct Ground {
    service: Service,
    transport: MemoryTransport,
}

fn open(network: &MemoryNetwork, folder: &Path, expected: Expected) -> Ground {
    open_with(network, folder, expected, MergeSettings { vouched: true, ..MergeSettings::default() })
}

fn open_with(network: &MemoryNetwork, folder: &Path, expected: Expected, merge: MergeSettings) -> Ground {
    let identity = identity("aggregator", Role::Aggregator);
    let transport = network.join(&identity);
    let folder = folder.to_path_buf();
    let config = ServiceConfig { identity, folder, limits: LIMITS, expected, merge, threads: 1 };
    Ground { service: Service::open(config).unwrap(), transport }
}

fn fleet(names: &[&str]) -> Expected {
    Expected::Devices(names.iter().map(|name| DeviceId::new(name).unwrap()).collect())
}

/// Runs service and drones until `enough` accepts the events so far and the drones. Returns the events.
fn simulate(
    network: &MemoryNetwork,
    ground: &mut Ground,
    drones: &mut [Drone],
    mut enough: impl FnMut(&[ServiceEvent], &[Drone]) -> bool,
) -> Vec<ServiceEvent> {
    let mut events = Vec::new();
    while !enough(&events, drones) {
        step(network, ground, drones, &mut events);
    }
    events
}

/// Runs a service in a folder until two drones have the global model, and stops it. Returns the drones.
fn delivered_and_stopped(network: &MemoryNetwork, folder: &Path) -> Vec<Drone> {
    let mut drones = drones(network, 2);
    let mut ground = open(network, folder, fleet(&["agent-1", "agent-2"]));
    let delivered = |events: &[ServiceEvent], _: &[Drone]| events.contains(&ServiceEvent::Delivered);
    simulate(network, &mut ground, &mut drones, delivered);
    network.leave(ground.transport);
    drones
}

/// Runs service and drones until `enough` accepts the state of the service and the events so far.
fn simulate_until(
    network: &MemoryNetwork,
    ground: &mut Ground,
    drones: &mut [Drone],
    mut enough: impl FnMut(&mut Ground, &[ServiceEvent]) -> bool,
) {
    let mut events = Vec::new();
    while !enough(ground, &events) {
        step(network, ground, drones, &mut events);
    }
}

fn step(network: &MemoryNetwork, ground: &mut Ground, drones: &mut [Drone], events: &mut Vec<ServiceEvent>) {
    assert!(network.now() < PATIENCE, "{events:?}");
    let now = network.now();
    drones.iter_mut().for_each(|drone| drone.step(now));
    let _ = ground.service.step(
        &mut ground.transport,
        || now,
        Duration::ZERO,
        |event| {
            events.push(event);
            ControlFlow::Continue(())
        },
    );
    // A merge takes real time, so virtual time stands still while it runs.
    match ground.service.keeper.is_merging() {
        true => std::thread::sleep(Duration::from_micros(200)),
        false => network.advance(now + Duration::from_millis(5)),
    }
}

fn count(events: &[ServiceEvent], which: fn(&ServiceEvent) -> bool) -> usize {
    events.iter().filter(|event| which(event)).count()
}

fn is_stored(event: &ServiceEvent) -> bool {
    matches!(event, ServiceEvent::Stored { .. })
}

fn is_disk_failure(event: &ServiceEvent) -> bool {
    matches!(event, ServiceEvent::DiskFailed { .. })
}

fn is_merged(event: &ServiceEvent) -> bool {
    matches!(event, ServiceEvent::Merged { .. })
}

#[test]
fn the_global_model_has_the_same_bytes_despite_faults_and_reaches_every_drone() {
    let mut bytes = Vec::new();
    for seed in [1, 2, 3] {
        let folder = tempfile::tempdir().unwrap();
        let network = MemoryNetwork::new(seed, BAD_WEATHER);
        let mut drones = drones(&network, 3);
        let mut ground = open(&network, folder.path(), fleet(&["agent-1", "agent-2", "agent-3"]));
        let delivered = |events: &[ServiceEvent], _: &[Drone]| events.contains(&ServiceEvent::Delivered);
        let events = simulate(&network, &mut ground, &mut drones, delivered);
        assert_eq!(count(&events, is_merged), 1, "merged once, after all models have arrived");
        assert!(drones.iter().all(|drone| drone.global == ground.service.keeper.global()));
        let splats = ply::read(&global_ply(folder.path()), &LocalFrame::WORLD).unwrap();
        let of_drone = |x: f32| splats.means.iter().filter(|mean| mean[0] == x).count();
        assert_eq!([1.0, 2.0, 3.0].map(of_drone), [900, 700, 2]);
        bytes.push(fs::read(global_ply(folder.path())).unwrap());
    }
    assert!(bytes.windows(2).all(|pair| pair[0] == pair[1]));
}

#[test]
fn without_a_fleet_every_arrival_makes_a_revision() {
    let folder = tempfile::tempdir().unwrap();
    let network = MemoryNetwork::new(5, BAD_WEATHER);
    let mut drones = drones(&network, 3);
    let mut ground = open(&network, folder.path(), Expected::Anybody(AT_ONCE));
    let all = |events: &[ServiceEvent], drones: &[Drone]| {
        count(events, is_merged) == 3
            && drones.iter().all(|drone| drone.global.is_some_and(|global| global.model == ModelId(3)))
    };
    simulate(&network, &mut ground, &mut drones, all);
    assert_eq!(ground.service.keeper.global().unwrap().splats, 1602);
}

#[test]
fn a_drone_that_is_given_up_is_not_waited_for_but_its_model_counts() {
    let folder = tempfile::tempdir().unwrap();
    let network = MemoryNetwork::new(6, BAD_WEATHER);
    let mut drones = drones(&network, 2);
    let mut ground = open(&network, folder.path(), fleet(&["agent-1", "agent-2", "agent-3"]));
    let both_stored = |events: &[ServiceEvent], _: &[Drone]| count(events, is_stored) == 2;
    let events = simulate(&network, &mut ground, &mut drones, both_stored);
    assert_eq!(count(&events, is_merged), 0, "agent-3 is awaited");
    let (say, commands) = mpsc::channel();
    for name in ["agent-2", "agent-3"] {
        say.send(Command::GiveUp(DeviceId::new(name).unwrap())).unwrap();
    }
    let Service { keeper, node } = &mut ground.service;
    assert_eq!(keeper.obey(node, &commands, Duration::ZERO), RunState::Running);
    let delivered = |events: &[ServiceEvent], _: &[Drone]| events.contains(&ServiceEvent::Delivered);
    simulate(&network, &mut ground, &mut drones, delivered);
    assert_eq!(drones[0].global.unwrap().splats, 1600, "agent-2 sent before it was given up");
}

#[test]
fn a_restarted_service_keeps_models_and_revision() {
    let folder = tempfile::tempdir().unwrap();
    let network = MemoryNetwork::new(7, BAD_WEATHER);
    let names = fleet(&["agent-1", "agent-2", "agent-3"]);
    let merged = |events: &[ServiceEvent], _: &[Drone]| count(events, is_merged) == 1;
    let mut ground = open(&network, folder.path(), names.clone());
    simulate(&network, &mut ground, &mut drones(&network, 3), merged);
    let before = ground.service.keeper.global();
    drop(ground);
    let network = MemoryNetwork::new(8, BAD_WEATHER);
    let mut ground = open(&network, folder.path(), names);
    assert_eq!(ground.service.keeper.global(), before, "read back from the disk");
    let mut drones = drones(&network, 3);
    for (drone, global) in drones.iter_mut().zip(before) {
        drone.node = Node::new(identity("agent-1", Role::Device), LIMITS, &[global]);
    }
    let all = |_: &[ServiceEvent], drones: &[Drone]| drones.iter().all(|drone| drone.global == before);
    simulate(&network, &mut ground, &mut drones, all);
    assert_eq!(ground.service.keeper.global(), before, "the same bytes keep their revision");
}

#[test]
fn a_failed_write_is_reported_and_a_model_is_acknowledged_only_once_stored() {
    let folder = tempfile::tempdir().unwrap();
    let network = MemoryNetwork::new(8, BAD_WEATHER);
    let mut drones = drones(&network, 3);
    let mut ground = open(&network, folder.path(), fleet(&["agent-1", "agent-2", "agent-3"]));
    let (models, away) = (folder.path().join("models"), folder.path().join("away"));
    fs::rename(&models, &away).unwrap();
    let refused = |events: &[ServiceEvent], _: &[Drone]| count(events, is_disk_failure) == 2;
    let events = simulate(&network, &mut ground, &mut drones, refused);
    assert_eq!(count(&events, is_stored), 0);
    assert!(events.iter().any(|event| event.to_string().contains("models")), "{events:?}");
    fs::rename(&away, &models).unwrap();
    let delivered = |events: &[ServiceEvent], _: &[Drone]| events.contains(&ServiceEvent::Delivered);
    let events = simulate(&network, &mut ground, &mut drones, delivered);
    assert_eq!(count(&events, is_stored), 3, "each model was requested again and arrived");
}

#[test]
fn fault_16_a_kill_during_a_merge_does_not_change_the_bytes() {
    let names = fleet(&["agent-1", "agent-2", "agent-3"]);
    let delivered = |events: &[ServiceEvent], _: &[Drone]| events.contains(&ServiceEvent::Delivered);
    let fly = |folder: &Path, seed: u64| {
        let network = MemoryNetwork::new(seed, BAD_WEATHER);
        let mut ground = open(&network, folder, names.clone());
        simulate(&network, &mut ground, &mut drones(&network, 3), delivered);
        fs::read(global_ply(folder)).unwrap()
    };
    let calm = tempfile::tempdir().unwrap();
    let undisturbed = fly(calm.path(), 20);
    for seed in 21..24 {
        let folder = tempfile::tempdir().unwrap();
        let network = MemoryNetwork::new(seed, BAD_WEATHER);
        let mut ground = open(&network, folder.path(), names.clone());
        let all_stored = |events: &[ServiceEvent], _: &[Drone]| count(events, is_stored) == 3;
        simulate(&network, &mut ground, &mut drones(&network, 3), all_stored);
        for _ in 0..1000 {
            if ground.service.keeper.is_merging() {
                break;
            }
            let now = network.now();
            let quiet = |_| ControlFlow::Continue(());
            let _ = ground.service.step(&mut ground.transport, || now, Duration::ZERO, quiet);
        }
        assert!(ground.service.keeper.is_merging(), "seed {seed}");
        drop(ground);
        assert!(!global_ply(folder.path()).exists(), "seed {seed}: the merge was over already");
        assert!(fly(folder.path(), seed + 100) == undisturbed, "seed {seed}");
    }
}

#[test]
fn a_device_beyond_the_limit_is_told_with_the_setting() {
    let folder = tempfile::tempdir().unwrap();
    let network = MemoryNetwork::new(7, Faults::NONE);
    let mut drones = drones(&network, 2);
    let Ground { service, transport } = open(&network, folder.path(), fleet(&["agent-1", "agent-2"]));
    let mut ground = Ground { service: service.with_devices_max(2), transport };
    let is_told = |event: &ServiceEvent| match event {
        ServiceEvent::Ignored { reason } => reason.ends_with("raise `devices_max`"),
        _ => false,
    };
    let delivered = |events: &[ServiceEvent], _: &[Drone]| events.contains(&ServiceEvent::Delivered);
    let events = simulate(&network, &mut ground, &mut drones, delivered);
    assert_eq!(count(&events, is_told), 1, "{events:?}");
    assert!(drones.iter().all(|drone| drone.global.is_some()), "devices with a merged model get the result");
}
