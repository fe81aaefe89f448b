//! An upload stalls: the part that has arrived is merged, until the rest arrives.

use cosurf_link::{FirstLayer, model_to_body};
use cosurf_scene::LocalFrame;
use glam::DVec3;

use super::damage::{SWEPT, copy, list_files};
use super::*;
use crate::gate::tests::{elsewhere, flights};
use crate::testing::QUICK;

/// The model of agent-1 has no ground east of this x.
const BEYOND: f32 = 16.0;

/// An upload of `model` in small chunks, the easternmost splats first.
fn slow_offer(number: u64, model: &Model) -> Offer {
    let Model { splats, cameras } = model;
    let device = DeviceId::new("agent-2").unwrap();
    let east: Vec<f32> = splats.means.iter().map(|mean| mean[0]).collect();
    let body = model_to_body(splats, cameras, &LocalFrame::WORLD, FirstLayer::ByImportance(&east)).unwrap();
    let mut offer = Offer::from_body(device, ModelId(number), ModelKind::Local, 3, body).unwrap();
    offer.header.chunk_bytes = 256;
    offer
}

/// A drone with such an upload.
fn slow_drone(network: &MemoryNetwork, number: u64, model: &Model) -> Drone {
    let mut drone = Drone::new(network, "agent-2", number, model);
    drone.node = Node::new(identity("agent-2", Role::Device), LIMITS, &[]);
    drone.node.upload(slow_offer(number, model));
    drone
}

/// A network slow enough to interrupt uploads.
fn slow_network(seed: u64) -> MemoryNetwork {
    MemoryNetwork::new(seed, Faults { bytes_per_s: std::num::NonZeroU32::new(3000), ..Faults::NONE })
}

/// Adds a slow drone that falls silent once a part of its model has arrived. Then the drone is given up.
fn stall(network: &MemoryNetwork, ground: &mut Ground, drones: &mut Vec<Drone>, number: u64, model: &Model) {
    drones.push(slow_drone(network, number, model));
    let key = ModelKey { device: DeviceId::new("agent-2").unwrap(), model: ModelId(number) };
    simulate_until(network, ground, drones, |ground, _| ground.service.node.part(key).is_some());
    drones[1].node = Node::new(identity("agent-2", Role::Device), LIMITS, &[]);
    let (say, commands) = mpsc::channel();
    say.send(Command::GiveUp(key.device)).unwrap();
    let Service { keeper, node } = &mut ground.service;
    assert_eq!(keeper.obey(node, &commands, network.now()), RunState::Running);
}

fn has_merged(events: &[ServiceEvent], of: usize) -> bool {
    matches!(events.last(), Some(ServiceEvent::Merged { models, .. }) if *models == of)
}

fn splats_beyond(folder: &Path) -> usize {
    ply::read(&global_ply(folder), &LocalFrame::WORLD)
        .unwrap()
        .means
        .iter()
        .filter(|mean| mean[0] > BEYOND)
        .count()
}

#[test]
fn the_part_of_a_stalled_upload_is_used_until_the_rest_arrives() {
    let models = flights();
    let names = fleet(&["agent-1", "agent-2"]);
    let folders = [(); 2].map(|()| tempfile::tempdir().unwrap());
    let [site, calm] = folders.each_ref().map(|folder| folder.path());
    let network = MemoryNetwork::new(1, Faults::NONE);
    let mut ground = open_with(&network, calm, names.clone(), QUICK);
    let mut drones =
        vec![Drone::new(&network, "agent-1", 1, &models[0]), slow_drone(&network, 1, &models[2])];
    simulate(&network, &mut ground, &mut drones, |events, _| has_merged(events, 2));
    let whole = fs::read(global_ply(calm)).unwrap();

    let network = slow_network(2);
    let mut ground = open_with(&network, site, names.clone(), QUICK);
    let mut drones = vec![Drone::new(&network, "agent-1", 1, &models[0])];
    simulate(&network, &mut ground, &mut drones, |events, _| count(events, is_stored) == 1);
    stall(&network, &mut ground, &mut drones, 1, &models[2]);
    let events = simulate(&network, &mut ground, &mut drones, |events, _| has_merged(events, 2));
    let part = events.iter().find_map(|event| match event {
        ServiceEvent::PartTaken { header, of_splats } => Some((header.splats, *of_splats)),
        _ => None,
    });
    let (some, all) = part.expect("the part is reported");
    assert!(some > 0 && some < all, "{some} of {all}");
    let record = Merging::read(site).unwrap();
    assert_eq!(record.inputs.iter().map(|input| input.part_splats).collect::<Vec<_>>(), [None, Some(some)]);
    let (coarse, fine) = (splats_beyond(site), splats_beyond(calm));
    assert!(coarse > 0 && coarse < fine, "{coarse} of {fine} splats where only the stalled drone has been");

    // A restarted service still has the part, and replaces it once the rest arrives.
    drop(ground);
    let network = MemoryNetwork::new(3, Faults::NONE);
    let mut ground = open_with(&network, site, names, QUICK);
    let mut drones = vec![slow_drone(&network, 1, &models[2])];
    let all_here =
        |events: &[ServiceEvent], _: &[Drone]| count(events, is_stored) == 1 && has_merged(events, 2);
    simulate(&network, &mut ground, &mut drones, all_here);
    assert!(
        fs::read(global_ply(site)).unwrap() == whole,
        "a resumed upload gives the same bytes as an uninterrupted one"
    );
    assert_eq!(fs::read_dir(site.join("parts")).unwrap().count(), 0);
}

/// Bytes that a drone sends until its model is stored, if the service is killed `kills` times on the way.
fn sent_despite_kills(kills: u32) -> u64 {
    let folder = tempfile::tempdir().unwrap();
    let network = slow_network(5);
    let names = fleet(&["agent-1", "agent-2"]);
    let mut ground = open_with(&network, folder.path(), names.clone(), QUICK);
    let model = model(3000, 0, 2.0);
    let mut drone = slow_drone(&network, 1, &model);
    let body_bytes = slow_offer(1, &model).header.body_bytes;
    let mut killed = 0;
    loop {
        let now = network.now();
        assert!(now < PATIENCE, "the model does not arrive");
        if let Some(NodeEvent::Uploaded(_, progress)) =
            drone.node.step(&mut drone.transport, || now, Duration::ZERO)
        {
            assert_eq!(killed, kills);
            return progress.bytes_sent;
        }
        let _ =
            ground.service.step(&mut ground.transport, || now, Duration::ZERO, |_| ControlFlow::Continue(()));
        network.advance(now + Duration::from_millis(5));
        let here = on_disk(folder.path());
        if killed < kills && here > u64::from(killed + 1) * body_bytes / u64::from(kills + 1) {
            network.leave(ground.transport);
            drop(ground.service);
            ground = open_with(&network, folder.path(), names.clone(), QUICK);
            killed += 1;
        }
    }
}

/// Bytes of unfinished models in the folder of a service.
fn on_disk(folder: &Path) -> u64 {
    let entries = fs::read_dir(folder.join("models")).unwrap().map(|entry| entry.unwrap());
    let arrived = entries.filter(|entry| entry.path().extension().is_some_and(|its| its == "arrived"));
    arrived.map(|entry| entry.metadata().unwrap().len()).sum()
}

#[test]
fn a_killed_service_goes_on_with_an_unfinished_upload() {
    let (calm, killed) = (sent_despite_kills(0), sent_despite_kills(4));
    // Each kill loses what is on the line, here of two seconds. If it lost all that had arrived, three times as much would
    // be sent.
    assert!(killed < calm + calm / 2, "{killed} bytes were sent, {calm} without kills");
}

#[test]
fn damage_to_a_part_is_survived_and_the_whole_model_replaces_it() {
    let models = flights();
    let names = fleet(&["agent-1", "agent-2"]);
    let undamaged = tempfile::tempdir().unwrap();
    let network = slow_network(2);
    let mut ground = open_with(&network, undamaged.path(), names.clone(), QUICK);
    let mut drones = vec![Drone::new(&network, "agent-1", 1, &models[0])];
    simulate(&network, &mut ground, &mut drones, |events, _| count(events, is_stored) == 1);
    stall(&network, &mut ground, &mut drones, 1, &models[2]);
    simulate(&network, &mut ground, &mut drones, |events, _| has_merged(events, 2));
    drop(ground);
    let mut files = Vec::new();
    list_files(undamaged.path(), &undamaged.path().join("parts"), &mut files);
    assert!(!files.is_empty());
    let mut whole = None;
    for (file, (name, damage)) in files.iter().flat_map(|file| SWEPT.map(|damage| (file, damage))) {
        let folder = tempfile::tempdir().unwrap();
        copy(undamaged.path(), folder.path());
        damage(&folder.path().join(file));
        let network = MemoryNetwork::new(3, Faults::NONE);
        let mut ground = open_with(&network, folder.path(), names.clone(), QUICK);
        let mut drones = vec![slow_drone(&network, 1, &models[2])];
        let is_over =
            |events: &[ServiceEvent], _: &[Drone]| count(events, is_stored) == 1 && has_merged(events, 2);
        let events = simulate(&network, &mut ground, &mut drones, is_over);
        assert_eq!(count(&events, is_disk_failure), 0, "{}, {name}: {events:?}", file.display());
        let global = fs::read(global_ply(folder.path())).unwrap();
        assert!(*whole.get_or_insert(global.clone()) == global, "{}, {name}: other bytes", file.display());
    }
}

#[test]
fn a_part_that_contradicts_the_others_is_kept_out_and_told() {
    let models = flights();
    let folder = tempfile::tempdir().unwrap();
    let network = slow_network(6);
    let mut ground = open_with(&network, folder.path(), fleet(&["agent-1", "agent-2"]), QUICK);
    let mut drones = vec![Drone::new(&network, "agent-1", 1, &models[0])];
    simulate(&network, &mut ground, &mut drones, |events, _| count(events, is_stored) == 1);
    let raised = elsewhere(models[1].clone(), 1.0, 0.0, 1.5 * DVec3::Z);
    stall(&network, &mut ground, &mut drones, 1, &raised);
    simulate(&network, &mut ground, &mut drones, |events, _| has_merged(events, 1));
    let record = Merging::read(folder.path()).unwrap();
    let told: Vec<String> = record.kept_out.iter().map(ToString::to_string).collect();
    assert_eq!(
        told,
        ["model 1 of agent-2 contradicts the other models (different ground, place, scale or brightness)"]
    );
    assert_eq!(
        record.summary.splats,
        ply::read(&global_ply(folder.path()), &LocalFrame::WORLD).unwrap().len()
    );
    assert_eq!(splats_beyond(folder.path()), 0, "the raised model has splats there");
}

#[test]
fn a_part_is_withdrawn_with_its_device_but_a_part_of_a_later_model_counts() {
    let models = flights();
    let folder = tempfile::tempdir().unwrap();
    let network = slow_network(4);
    let mut ground = open_with(&network, folder.path(), fleet(&["agent-1", "agent-2"]), QUICK);
    let mut drones = vec![Drone::new(&network, "agent-1", 1, &models[0])];
    simulate(&network, &mut ground, &mut drones, |events, _| count(events, is_stored) == 1);
    stall(&network, &mut ground, &mut drones, 1, &models[2]);
    simulate(&network, &mut ground, &mut drones, |events, _| has_merged(events, 2));
    assert!(splats_beyond(folder.path()) > 0);

    withdraw(folder.path(), &DeviceId::new("agent-2").unwrap()).unwrap();
    simulate(&network, &mut ground, &mut drones, |events, _| has_merged(events, 1));
    assert_eq!(splats_beyond(folder.path()), 0);

    network.leave(drones.pop().unwrap().transport);
    // The withdrawn model would not count under another number either.
    let Model { splats, cameras } = &models[2];
    let later = Model { splats: splats.without(&[0]), cameras: cameras.clone() };
    stall(&network, &mut ground, &mut drones, 2, &later);
    simulate(&network, &mut ground, &mut drones, |events, _| has_merged(events, 2));
    assert!(splats_beyond(folder.path()) > 0);
    let until = network.now() + Duration::from_secs(5);
    let events = simulate(&network, &mut ground, &mut drones, |_, _| network.now() >= until);
    let is_withdrawn = |event: &ServiceEvent| matches!(event, ServiceEvent::Withdrawn { .. });
    assert!(!events.iter().any(is_withdrawn) && splats_beyond(folder.path()) > 0, "{events:?}");
}

#[test]
fn the_flight_of_a_withdrawn_device_is_withdrawn_too() {
    let models = flights();
    let folder = tempfile::tempdir().unwrap();
    let network = MemoryNetwork::new(5, Faults::NONE);
    let mut ground = open_with(&network, folder.path(), fleet(&["agent-1", "agent-2"]), QUICK);
    let mut drones = vec![Drone::new(&network, "agent-2", 1, &models[2])];
    drones[0].node.announce_flight(&models[2].cameras);
    let device = DeviceId::new("agent-2").unwrap();
    let flight = Topic::Flight { device }.to_text(&identity("agent-2", Role::Device).site);
    let is_told = || network.retained(&flight).is_some_and(|bytes| !bytes.is_empty());
    simulate(&network, &mut ground, &mut drones, |_, _| is_told());
    withdraw(folder.path(), &device).unwrap();
    simulate(&network, &mut ground, &mut drones, |_, _| !is_told());
}
