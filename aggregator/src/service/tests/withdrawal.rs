//! Devices are withdrawn until no model is left to merge: no global model remains, until a new model arrives.

use super::*;
use crate::testing::{QUICK, above, ground, model_at};

fn is_global_withdrawn(event: &ServiceEvent) -> bool {
    *event == ServiceEvent::GlobalWithdrawn
}

fn has_global(folder: &Path) -> bool {
    global_ply(folder).exists() || Merging::read(folder).is_some()
}

fn forget(folder: &Path, name: &str) {
    withdraw(folder, &DeviceId::new(name).unwrap()).unwrap();
}

/// Simulates until a global model is merged from one model, and `kept_out` models are kept out of it.
fn merge_one(network: &MemoryNetwork, ground: &mut Ground, drones: &mut [Drone], kept_out: usize) {
    let is_it = |event: &ServiceEvent| match event {
        ServiceEvent::Merged { models: 1, kept_out: others, .. } => others.len() == kept_out,
        _ => false,
    };
    simulate(network, ground, drones, |events, _| events.iter().any(is_it));
}

/// Simulates until the global model is withdrawn.
fn lose_global(network: &MemoryNetwork, ground: &mut Ground, drones: &mut [Drone]) {
    simulate(network, ground, drones, |events, _| count(events, is_global_withdrawn) == 1);
}

#[test]
fn ground_of_a_withdrawn_device_goes_although_too_few_are_left_for_a_quorum() {
    let folder = tempfile::tempdir().unwrap();
    let network = MemoryNetwork::new(32, Faults::NONE);
    let rounds = Rounds { quorum: 2, quiet: Duration::ZERO, deadline: Duration::from_secs(600) };
    let mut ground = open(&network, folder.path(), Expected::Anybody(rounds));
    let mut drones = drones(&network, 2);
    simulate(&network, &mut ground, &mut drones, |events, _| count(events, is_merged) == 1);
    forget(folder.path(), "agent-1");
    let forgotten = network.now();
    simulate(&network, &mut ground, &mut drones, |events, _| count(events, is_merged) == 1);
    assert!(network.now() < forgotten + Duration::from_secs(10));
    let left = Merging::read(folder.path()).unwrap().inputs;
    assert_eq!(left.iter().map(|input| input.device.as_str()).collect::<Vec<_>>(), ["agent-2"]);
}

#[test]
fn the_global_model_is_removed_with_its_last_device_and_the_next_revision_has_a_higher_number() {
    let folder = tempfile::tempdir().unwrap();
    let network = MemoryNetwork::new(31, Faults::NONE);
    let mut ground = open(&network, folder.path(), Expected::Anybody(AT_ONCE));
    let mut drones = drones(&network, 1);
    merge_one(&network, &mut ground, &mut drones, 0);
    assert!(has_global(folder.path()));

    forget(folder.path(), "agent-1");
    lose_global(&network, &mut ground, &mut drones);
    assert!(!has_global(folder.path()));

    network.leave(drones.pop().unwrap().transport);
    drones.push(Drone::new(&network, "agent-1", 2, &model(700, 0, 2.0)));
    merge_one(&network, &mut ground, &mut drones, 0);
    assert!(has_global(folder.path()));
    assert_eq!(ground.service.keeper.global().unwrap().model, ModelId(2));
}

#[test]
fn a_device_may_be_forgotten_while_the_service_is_stopped() {
    let folder = tempfile::tempdir().unwrap();
    let network = MemoryNetwork::new(32, Faults::NONE);
    let mut ground = open(&network, folder.path(), Expected::Anybody(AT_ONCE));
    merge_one(&network, &mut ground, &mut drones(&network, 1), 0);
    drop(ground);

    forget(folder.path(), "agent-1");
    let network = MemoryNetwork::new(33, Faults::NONE);
    let mut ground = open(&network, folder.path(), Expected::Anybody(AT_ONCE));
    let lost = |events: &[ServiceEvent], _: &[Drone]| count(events, is_global_withdrawn) == 1;
    let events = simulate(&network, &mut ground, &mut [], lost);
    let told = ServiceEvent::Withdrawn { device: DeviceId::new("agent-1").unwrap() };
    assert!(events.contains(&told), "{events:?}");
    assert!(!has_global(folder.path()));
}

/// As while the service runs: its ground goes at once.
#[test]
fn ground_of_a_device_that_was_forgotten_while_the_service_was_stopped_does_not_wait_for_a_quorum() {
    let folder = tempfile::tempdir().unwrap();
    let network = MemoryNetwork::new(36, Faults::NONE);
    let mut ground = open(&network, folder.path(), Expected::Anybody(AT_ONCE));
    let mut drones = drones(&network, 2);
    simulate(&network, &mut ground, &mut drones, |_, _| {
        Merging::read(folder.path()).is_some_and(|record| record.inputs.len() == 2)
    });
    network.leave(ground.transport);
    drop(ground.service);
    forget(folder.path(), "agent-1");
    let never = Rounds { quorum: 2, quiet: Duration::ZERO, deadline: Duration::MAX };
    let mut ground = open(&network, folder.path(), Expected::Anybody(never));
    simulate(&network, &mut ground, &mut drones, |events, _| count(events, is_merged) == 1);
    let left = Merging::read(folder.path()).unwrap().inputs;
    assert_eq!(left.iter().map(|input| input.device.as_str()).collect::<Vec<_>>(), ["agent-2"]);
}

#[test]
fn the_global_model_is_removed_if_all_models_that_are_left_are_kept_out() {
    let folder = tempfile::tempdir().unwrap();
    let network = MemoryNetwork::new(34, Faults::NONE);
    let mut ground_station = open_with(&network, folder.path(), Expected::Anybody(AT_ONCE), QUICK);
    // The only camera of this model sees none of its splats.
    let unseen = Model { splats: ground(60.0, 64.0), cameras: vec![above(0.0)] };
    let sound = model_at(0.0);
    let models = [("agent-1", &sound), ("agent-2", &unseen)];
    let mut drones: Vec<Drone> =
        models.iter().map(|(name, model)| Drone::new(&network, name, 1, model)).collect();
    merge_one(&network, &mut ground_station, &mut drones, 1);

    forget(folder.path(), "agent-1");
    lose_global(&network, &mut ground_station, &mut drones);
    assert!(!has_global(folder.path()));
}

#[test]
fn only_devices_with_a_model_are_senders() {
    let folder = tempfile::tempdir().unwrap();
    assert!(senders(folder.path()).unwrap().is_empty(), "the service has never run");
    let network = MemoryNetwork::new(35, Faults::NONE);
    let mut ground = open(&network, folder.path(), Expected::Anybody(AT_ONCE));
    let mut drones = drones(&network, 1);
    merge_one(&network, &mut ground, &mut drones, 0);
    assert!(senders(folder.path()).unwrap().iter().map(DeviceId::as_str).eq(["agent-1"]));

    forget(folder.path(), "agent-1");
    lose_global(&network, &mut ground, &mut drones);
    assert!(senders(folder.path()).unwrap().is_empty());
}
