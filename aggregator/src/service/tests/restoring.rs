//! An older revision is restored, and a device is revoked, while the service runs and over a restart.

use std::path::PathBuf;

use super::*;

fn revision(ground: &Ground) -> u64 {
    ground.service.keeper.global().unwrap().model.0
}

fn splats(folder: &Path) -> usize {
    ply::read(&global_ply(folder), &LocalFrame::WORLD).unwrap().len()
}

fn is_restored(event: &ServiceEvent) -> bool {
    matches!(event, ServiceEvent::Restored { .. })
}

/// A service with two revisions: one of the first drone, and one of both.
fn with_two_revisions(network: &MemoryNetwork, folder: &Path) -> (Ground, Vec<Drone>) {
    let mut ground = open(network, folder, Expected::Anybody(AT_ONCE));
    let mut both = drones(network, 1);
    let merged =
        |count_of: usize| move |events: &[ServiceEvent], _: &[Drone]| count(events, is_merged) == count_of;
    simulate(network, &mut ground, &mut both, merged(1));
    both.push(Drone::new(network, "agent-2", 1, &model(700, 0, 2.0)));
    simulate(network, &mut ground, &mut both, merged(1));
    assert_eq!((revision(&ground), splats(folder)), (2, 1600));
    (ground, both)
}

#[test]
fn a_restored_revision_reaches_every_drone_and_stays_until_a_merge_is_asked_for() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let network = MemoryNetwork::new(61, Faults::NONE);
    let (mut ground, mut drones) = with_two_revisions(&network, path);
    let listed: Vec<u64> = old_revisions(path).unwrap().iter().map(|old| old.revision).collect();
    assert_eq!(listed, [1]);
    let unknown = ask_to_restore(path, 9).unwrap_err().to_string();
    assert!(unknown.contains("can be restored: 1"), "{unknown}");
    let newest = ask_to_restore(path, 2).unwrap_err().to_string();
    assert_eq!(newest, "revision 2 is the newest one already; others that can be restored: 1");

    ask_to_restore(path, 1).unwrap();
    let everywhere = |_: &[ServiceEvent], drones: &[Drone]| {
        drones.iter().all(|drone| drone.global.is_some_and(|global| global.model == ModelId(3)))
    };
    let events = simulate(&network, &mut ground, &mut drones, everywhere);
    assert_eq!(count(&events, is_restored), 1, "{events:?}");
    assert_eq!((revision(&ground), splats(path)), (3, 900));

    // Another model is stored, and its drone gets the restored revision.
    drones.push(Drone::new(&network, "agent-3", 1, &model(2, 1, 3.0)));
    let events = simulate(&network, &mut ground, &mut drones, everywhere);
    assert_eq!(count(&events, is_stored), 1);
    assert_eq!((revision(&ground), splats(path)), (3, 900), "it stays");

    // Over a restart, too.
    network.leave(ground.transport);
    let mut ground = open(&network, path, Expected::Anybody(AT_ONCE));
    let offered = |events: &[ServiceEvent], _: &[Drone]| count(events, is_restored) == 1;
    simulate(&network, &mut ground, &mut drones, offered);
    assert_eq!((revision(&ground), splats(path)), (3, 900), "it stays over a restart");

    // And if its record is lost.
    network.leave(ground.transport);
    std::fs::remove_file(path.join("merged.json")).unwrap();
    let mut ground = open(&network, path, Expected::Anybody(AT_ONCE));
    simulate(&network, &mut ground, &mut drones, |events, _| count(events, is_restored) == 1);
    assert_eq!((revision(&ground), splats(path)), (3, 900), "it is restored again, with the same bytes");

    ask_to_release(path).unwrap();
    let merged = |events: &[ServiceEvent], _: &[Drone]| count(events, is_merged) == 1;
    simulate(&network, &mut ground, &mut drones, merged);
    assert_eq!((revision(&ground), splats(path)), (4, 1602), "all models count again");
    assert!(Merging::read(path).unwrap().restored_from.is_none());
}

/// Wishes within the second that the service takes to notice: all are fulfilled, one after the other, and a merge that was asked
/// for is not stopped although it takes longer than that second.
#[test]
fn wishes_are_fulfilled_in_their_order() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let network = MemoryNetwork::new(67, Faults::NONE);
    let (mut ground, mut drones) = with_two_revisions(&network, path);
    ask_to_restore(path, 1).unwrap();
    simulate(&network, &mut ground, &mut drones, |events, _| count(events, is_restored) == 1);
    assert_eq!((revision(&ground), splats(path)), (3, 900));
    ask_to_release(path).unwrap();
    ask_to_restore(path, 1).unwrap();
    ask_to_restore(path, 1).unwrap();
    ask_to_restore(path, 2).unwrap();
    let mut events = Vec::new();
    while count(&events, is_restored) < 2 {
        step(&network, &mut ground, &mut drones, &mut events);
        // Time goes on while a merge runs, unlike in other tests.
        network.advance(network.now() + Duration::from_millis(20));
    }
    let from: Vec<u64> = events
        .iter()
        .filter_map(|event| match event {
            ServiceEvent::Restored { from, .. } => Some(*from),
            _ => None,
        })
        .collect();
    assert_eq!(from, [1, 2], "{events:?}");
    assert_eq!(count(&events, is_merged), 3, "a merge of all models, and two restored ones: {events:?}");
    assert_eq!((revision(&ground), splats(path)), (6, 1600));
    for _ in 0..8 {
        ask_to_release(path).unwrap();
        ask_to_restore(path, 1).unwrap();
    }
    assert!(matches!(ask_to_release(path), Err(RestoreError::Busy)));
    ask_to_restore(path, 1).unwrap(); // the last one already
}

/// A merge that was asked for is made, and before what was asked for behind it, although the program is killed while it merges
/// and too few devices are there for a quorum.
#[test]
fn a_merge_that_was_asked_for_outlasts_a_kill() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let network = MemoryNetwork::new(68, Faults::NONE);
    let (mut ground, mut drones) = with_two_revisions(&network, path);
    ask_to_restore(path, 1).unwrap();
    simulate(&network, &mut ground, &mut drones, |events, _| count(events, is_restored) == 1);
    ask_to_release(path).unwrap();
    ask_to_restore(path, 1).unwrap();
    let begun = |ground: &mut Ground, _: &[ServiceEvent]| ground.service.is_merging();
    simulate_until(&network, &mut ground, &mut drones, begun);
    network.leave(ground.transport);
    drop(ground.service);
    let never = Rounds { quorum: 9, quiet: Duration::MAX, deadline: Duration::MAX };
    let mut ground = open(&network, path, Expected::Anybody(never));
    let events = simulate(&network, &mut ground, &mut drones, |events, _| count(events, is_restored) == 1);
    assert_eq!(count(&events, is_merged), 2, "the merge, and the restored one: {events:?}");
    assert_eq!((revision(&ground), splats(path)), (5, 900), "a merge came between the copies of revision 1");
    simulate(&network, &mut ground, &mut drones, |_, _| !path.join("restore").exists());
}

#[test]
fn ground_of_a_forgotten_device_is_not_restored_and_does_not_stay() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let network = MemoryNetwork::new(62, Faults::NONE);
    let (mut ground, mut drones) = with_two_revisions(&network, path);
    ask_to_restore(path, 1).unwrap();
    let restored = |events: &[ServiceEvent], _: &[Drone]| count(events, is_restored) == 1;
    simulate(&network, &mut ground, &mut drones, restored);
    withdraw(path, &DeviceId::new("agent-1").unwrap()).unwrap();
    let refused = ask_to_restore(path, 2).unwrap_err().to_string();
    assert!(refused.contains("forgotten since; others that can be restored: none"), "{refused}");
    let merged = |events: &[ServiceEvent], _: &[Drone]| count(events, is_merged) == 1;
    simulate(&network, &mut ground, &mut drones, merged);
    assert_eq!((revision(&ground), splats(path)), (4, 700), "only agent-2 is left");
    assert!(old_revisions(path).unwrap().is_empty(), "all older ones show agent-1");
}

/// One changed bit in the name of a device would hide that its ground must go.
#[test]
fn ground_of_a_forgotten_device_does_not_stay_although_a_bit_of_its_name_has_changed() {
    let files: [fn(&Path) -> PathBuf; 2] =
        [|path| path.join("merged.json"), |path| path.join("revisions").join("1.json")];
    for damaged in [&files[..1], &files[1..], &files[..]] {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path();
        let network = MemoryNetwork::new(64, Faults::NONE);
        let (mut ground, mut drones) = with_two_revisions(&network, path);
        ask_to_restore(path, 1).unwrap();
        let restored = |events: &[ServiceEvent], _: &[Drone]| count(events, is_restored) == 1;
        simulate(&network, &mut ground, &mut drones, restored);
        network.leave(ground.transport);
        for file in damaged {
            let text = fs::read_to_string(file(path)).unwrap();
            fs::write(file(path), text.replace("agent-1", "agent-0")).unwrap();
        }
        withdraw(path, &DeviceId::new("agent-1").unwrap()).unwrap();
        let mut ground = open(&network, path, Expected::Anybody(AT_ONCE));
        let merged = |events: &[ServiceEvent], _: &[Drone]| count(events, is_merged) == 1;
        simulate(&network, &mut ground, &mut drones, merged);
        assert_eq!(splats(path), 700, "only agent-2 is left: {}", damaged.len());
    }
}

#[test]
fn a_revision_whose_model_is_damaged_is_refused_with_those_that_are_left() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let network = MemoryNetwork::new(65, Faults::NONE);
    let (mut ground, mut drones) = with_two_revisions(&network, path);
    drones.push(Drone::new(&network, "agent-3", 1, &model(2, 1, 3.0)));
    let merged = |events: &[ServiceEvent], _: &[Drone]| count(events, is_merged) == 1;
    simulate(&network, &mut ground, &mut drones, merged);
    let model = path.join("global").join("aggregator.1.model");
    let mut bytes = fs::read(&model).unwrap();
    *bytes.last_mut().unwrap() ^= 1;
    fs::write(&model, bytes).unwrap();
    let refused = ask_to_restore(path, 1).unwrap_err().to_string();
    assert_eq!(refused, "the model of revision 1 is damaged; others that can be restored: 2");

    // A wish that came before the damage, and one that is itself damaged.
    fs::write(path.join("restore"), "1").unwrap();
    let told = |events: &[ServiceEvent], _: &[Drone]| {
        events.iter().any(|event| event.to_string().contains("others that can be restored: 2"))
    };
    simulate(&network, &mut ground, &mut drones, told);
    fs::write(path.join("restore"), "1x").unwrap();
    let told = |events: &[ServiceEvent], _: &[Drone]| {
        events.iter().any(|event| event.to_string().contains("wish to restore a revision is damaged"))
    };
    simulate(&network, &mut ground, &mut drones, told);
    assert_eq!(revision(&ground), 3);
}

#[test]
fn a_revision_whose_record_is_damaged_is_told_and_listed_as_lost() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let network = MemoryNetwork::new(66, Faults::NONE);
    let (ground, drones) = with_two_revisions(&network, path);
    assert!(lost_revisions(path).unwrap().is_empty());
    network.leave(ground.transport);
    drones.into_iter().for_each(|drone| network.leave(drone.transport));
    fs::write(path.join("revisions/1.json"), "{").unwrap();
    let lost =
        || lost_revisions(path).unwrap().iter().map(|(_, fault)| fault.to_string()).collect::<Vec<_>>();
    let words = "the record of revision 1 (revisions/1.json) is damaged or missing";
    assert_eq!(lost(), [words]);
    let refused = ask_to_restore(path, 1).unwrap_err().to_string();
    assert_eq!(refused, format!("{words}; others that can be restored: none"));

    let mut ground = open(&network, path, Expected::Anybody(AT_ONCE));
    let told = |events: &[ServiceEvent], _: &[Drone]| {
        events.iter().any(|event| event.to_string().contains("its revision can be restored no longer"))
    };
    simulate(&network, &mut ground, &mut [], told);
    assert_eq!(lost(), [words]);
}

#[test]
fn a_revoked_device_is_not_heard_even_after_a_restart_until_it_is_let_in_again() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let network = MemoryNetwork::new(63, Faults::NONE);
    let device = DeviceId::new("agent-2").unwrap();
    revoke(path, &device).unwrap();
    for attempt in 0..2 {
        let mut drones = drones(&network, 2);
        let mut ground = open(&network, path, Expected::Anybody(AT_ONCE));
        let until = network.now() + Duration::from_secs(60);
        simulate(&network, &mut ground, &mut drones, |_, _| network.now() > until);
        let heard: Vec<ModelKey> = ground.service.keeper.counted();
        assert_eq!(heard.iter().map(|key| key.device.as_str()).collect::<Vec<_>>(), ["agent-1"], "{attempt}");
        network.leave(ground.transport);
        drones.into_iter().for_each(|drone| network.leave(drone.transport));
    }
    let mut drones = drones(&network, 2);
    let mut ground = open(&network, path, Expected::Anybody(AT_ONCE));
    assert!(readmit(path, &device).unwrap() && !readmit(path, &device).unwrap());
    let both = |ground: &mut Ground, _: &[ServiceEvent]| ground.service.keeper.counted().len() == 2;
    simulate_until(&network, &mut ground, &mut drones, both);
    revoke(path, &device).unwrap();
    let told = |events: &[ServiceEvent], _: &[Drone]| events.contains(&ServiceEvent::Revoked { device });
    simulate(&network, &mut ground, &mut drones, told);
    assert_eq!(ground.service.keeper.counted().len(), 2, "what it has sent counts until it is forgotten");
}
