//! Models that were acknowledged and are missing or damaged on the disk later.

use super::*;
use crate::testing::QUICK;

/// The file of the model of `agent-1`.
fn file(folder: &Path) -> std::path::PathBuf {
    folder.join("models/agent-1.1.model")
}

fn flip_a_bit(path: &Path) {
    let mut bytes = fs::read(path).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    fs::write(path, bytes).unwrap();
}

fn is_lost(event: &ServiceEvent) -> bool {
    matches!(event, ServiceEvent::Lost { .. })
}

#[test]
fn a_model_whose_file_is_deleted_is_asked_for_again_and_served() {
    let folder = tempfile::tempdir().unwrap();
    let network = MemoryNetwork::new(31, BAD_WEATHER);
    let mut drones = drones(&network, 2);
    let mut ground = open(&network, folder.path(), fleet(&["agent-1", "agent-2"]));
    let delivered = |events: &[ServiceEvent], _: &[Drone]| events.contains(&ServiceEvent::Delivered);
    simulate(&network, &mut ground, &mut drones, delivered);
    let before = fs::read(file(folder.path())).unwrap();
    fs::remove_file(file(folder.path())).unwrap();
    let events = simulate(&network, &mut ground, &mut drones, |events, _| count(events, is_stored) == 1);
    assert_eq!(count(&events, is_lost), 1, "{events:?}");
    assert!(fs::read(file(folder.path())).unwrap() == before);
}

/// The damage is found by the merge that the model of another drone begins. The others are merged meanwhile.
#[test]
fn a_model_with_a_flipped_bit_is_asked_for_again_and_served() {
    let folder = tempfile::tempdir().unwrap();
    let network = MemoryNetwork::new(32, BAD_WEATHER);
    let mut first = drones(&network, 1);
    let mut ground = open(&network, folder.path(), Expected::Anybody(AT_ONCE));
    let delivered = |events: &[ServiceEvent], _: &[Drone]| events.contains(&ServiceEvent::Delivered);
    simulate(&network, &mut ground, &mut first, delivered);
    let before = fs::read(file(folder.path())).unwrap();
    flip_a_bit(&file(folder.path()));
    first.push(Drone::new(&network, "agent-2", 1, &model(700, 0, 2.0)));
    let whole = |events: &[ServiceEvent], _: &[Drone]| {
        events.iter().any(|event| matches!(event, ServiceEvent::Merged { models: 2, .. }))
    };
    let events = simulate(&network, &mut ground, &mut first, whole);
    assert_eq!(count(&events, is_lost), 1, "{events:?}");
    assert_eq!(count(&events, is_stored), 2);
    assert!(fs::read(file(folder.path())).unwrap() == before);
    assert!(file(folder.path()).with_extension("damaged").exists());
}

/// The file goes while the service does not run. The drone is still there, and has had its acknowledgement.
#[test]
fn a_model_that_is_missing_at_the_start_is_asked_for_again_and_served() {
    let folder = tempfile::tempdir().unwrap();
    let network = MemoryNetwork::new(33, BAD_WEATHER);
    let mut drones = delivered_and_stopped(&network, folder.path());
    fs::remove_file(file(folder.path())).unwrap();
    let mut ground = open(&network, folder.path(), fleet(&["agent-1", "agent-2"]));
    simulate(&network, &mut ground, &mut drones, |events, _| count(events, is_stored) == 1);
    assert!(file(folder.path()).exists());
}

/// The service of a folder that is lost counts from 1 again, but devices still have its revisions.
#[test]
fn devices_with_revisions_of_a_lost_folder_get_the_next_one() {
    let folders = [(); 2].map(|()| tempfile::tempdir().unwrap());
    let [lost, fresh] = folders.each_ref().map(|folder| folder.path());
    let old = delivered_and_stopped(&MemoryNetwork::new(1, Faults::NONE), lost)[0].global.unwrap();

    // The drone is the only one in the fresh folder, which so gets another global model.
    let network = MemoryNetwork::new(2, Faults::NONE);
    let model = model(900, 1, 1.0);
    let mut drone = Drone::new(&network, "agent-1", 1, &model);
    let its = identity("agent-1", Role::Device);
    drone.node = Node::new(its, LIMITS, &[old]);
    let Model { splats, cameras } = &model;
    drone.node.upload(Offer::new(its.device, ModelId(1), ModelKind::Local, 3, splats, cameras).unwrap());
    let identity = Identity { session: 1_800_000_000, ..identity("aggregator", Role::Aggregator) };
    let transport = network.join(&identity);
    let (folder, expected) = (fresh.to_path_buf(), fleet(&["agent-1"]));
    let config = ServiceConfig { identity, folder, limits: LIMITS, expected, merge: QUICK, threads: 1 };
    let mut ground = Ground { service: Service::open(config).unwrap(), transport };
    let mut drones = [drone];
    let events = simulate(&network, &mut ground, &mut drones, |_, drones| drones[0].global.is_some());
    assert!(events.iter().any(|event| matches!(event, ServiceEvent::Outnumbered { .. })), "{events:?}");
    assert!(drones[0].global.unwrap().model > old.model);
}
