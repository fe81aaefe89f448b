//! Attacks on the service. The others are in `shared/link/tests/attacks`.

use cosurf_link::{Outgoing, Transport};
use cosurf_wire::{BodyHash, MAX_CONTROL_BYTES, Message};

use super::*;

const HIGHEST: u64 = (1 << 63) - 1;

/// A drone that sends one small model after the other does not keep the models of all from being merged, although the
/// round ends only once nothing has changed for a while.
#[test]
fn attack_07_a_device_that_sends_model_after_model_does_not_postpone_the_merge() {
    let folder = tempfile::tempdir().unwrap();
    let network = MemoryNetwork::new(7, Faults::NONE);
    let (quiet, deadline) = (Duration::from_secs(5), PATIENCE);
    let mut ground = open(&network, folder.path(), Expected::Anybody(Rounds { quorum: 1, quiet, deadline }));
    let mut drones = vec![
        Drone::new(&network, "agent-1", 1, &model(900, 1, 1.0)),
        Drone::new(&network, "agent-2", 1, &model(20, 0, 2.0)),
    ];
    let (mut events, mut number, mut next) = (Vec::new(), 1, Duration::ZERO);
    let begun = network.now();
    while count(&events, is_merged) == 0 {
        if network.now() >= next {
            (number, next) = (number + 1, network.now() + quiet / 2);
            let Model { splats, cameras } = model(20 + number as usize, 0, 2.0);
            let device = DeviceId::new("agent-2").unwrap();
            let offer = Offer::new(device, ModelId(number), ModelKind::Local, 3, &splats, &cameras).unwrap();
            drones[1].node.upload(offer);
        }
        step(&network, &mut ground, &mut drones, &mut events);
        assert!(network.now() - begun < 3 * quiet, "no revision after {:?}", network.now() - begun);
    }
    assert!(count(&events, is_stored) > 2, "the attack has not begun");
}

/// A stranger's model with the highest number there is, in the name of a drone. Once the drone is forgotten, its next model
/// counts, and the forgotten ones do not, not even after a restart.
#[test]
fn attack_09_a_high_number_does_not_ban_a_drone_for_ever() {
    let folder = tempfile::tempdir().unwrap();
    let network = MemoryNetwork::new(9, Faults::NONE);
    let mut ground = open(&network, folder.path(), Expected::Anybody(AT_ONCE));
    let merged = |times: usize| move |events: &[ServiceEvent], _: &[Drone]| count(events, is_merged) == times;
    let mut genuine = vec![Drone::new(&network, "agent-1", 6, &model(900, 1, 1.0))];
    simulate(&network, &mut ground, &mut genuine, merged(1));
    network.leave(genuine.remove(0).transport);
    let mut forged = vec![Drone::new(&network, "agent-1", HIGHEST, &model(20, 0, 2.0))];
    simulate(&network, &mut ground, &mut forged, merged(1));
    assert_eq!(ground.service.keeper.counted()[0].model, ModelId(HIGHEST), "the forged model counts");
    network.leave(forged.remove(0).transport);

    withdraw(folder.path(), &DeviceId::new("agent-1").unwrap()).unwrap();
    let is_forgotten = |events: &[ServiceEvent], _: &[Drone]| {
        count(events, |event| *event == ServiceEvent::GlobalWithdrawn) == 1
    };
    simulate(&network, &mut ground, &mut [], is_forgotten);
    let mut genuine = vec![Drone::new(&network, "agent-1", 7, &model(700, 0, 1.0))];
    simulate(&network, &mut ground, &mut genuine, merged(1));
    assert_eq!(ground.service.keeper.counted()[0].model, ModelId(7));
    drop(ground);

    // Not even if a drone gives it a higher number, as it does after a refusal because of the number.
    for (number, model) in [(12, model(900, 1, 1.0)), (HIGHEST, model(20, 0, 2.0))] {
        let network = MemoryNetwork::new(10, Faults::NONE);
        let mut ground = open(&network, folder.path(), Expected::Anybody(AT_ONCE));
        let mut again = vec![Drone::new(&network, "agent-1", number, &model)];
        let is_refused = |event: &ServiceEvent| match event {
            ServiceEvent::Ignored { reason } => reason.contains("withdrawn"),
            _ => false,
        };
        simulate(&network, &mut ground, &mut again, |events, _| count(events, is_refused) == 1);
        assert_eq!(ground.service.keeper.counted()[0].model, ModelId(7));
    }
}

/// Only a few models of a device are kept, however many it sends; the newest ones.
#[test]
fn attack_18_a_device_that_sends_many_models_does_not_fill_the_disk() {
    let folder = tempfile::tempdir().unwrap();
    let network = MemoryNetwork::new(18, Faults::NONE);
    let never = Rounds { quorum: 9, quiet: PATIENCE, deadline: PATIENCE };
    let mut ground = open(&network, folder.path(), Expected::Anybody(never));
    let mut drones = vec![Drone::new(&network, "agent-1", 1, &model(2, 0, 1.0))];
    for number in 1..=40 {
        let Model { splats, cameras } = model(2 + number as usize, 0, 1.0);
        let device = DeviceId::new("agent-1").unwrap();
        let offer = Offer::new(device, ModelId(number), ModelKind::Local, 3, &splats, &cameras).unwrap();
        drones[0].node.upload(offer);
        simulate(&network, &mut ground, &mut drones, |events, _| count(events, is_stored) == 1);
        let kept = fs::read_dir(folder.path().join("models")).unwrap().count();
        assert!(kept <= 4, "{kept} models are kept");
    }
    assert_eq!(ground.service.keeper.counted()[0].model, ModelId(40));
    // They are withdrawn with the others.
    withdraw(folder.path(), &DeviceId::new("agent-1").unwrap()).unwrap();
    let is_withdrawn = |event: &ServiceEvent| matches!(event, ServiceEvent::Withdrawn { .. });
    simulate(&network, &mut ground, &mut drones, |events, _| count(events, is_withdrawn) == 1);
    let listed = fs::read_to_string(folder.path().join("withdrawn/agent-1")).unwrap();
    let models = listed.lines().filter(|line| !line.starts_with(['f', '#']));
    assert_eq!(models.count(), 40);
}

/// No more devices than allowed have models on the disk, so strangers with many names do not fill it either.
#[test]
fn attack_18_models_of_more_devices_than_allowed_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let network = MemoryNetwork::new(18, Faults::NONE);
    let Ground { service, transport } = open(&network, folder.path(), Expected::Anybody(AT_ONCE));
    let mut ground = Ground { service: service.with_devices_max(2), transport };
    let mut drones = drones(&network, 3);
    let is_refused = |event: &ServiceEvent| match event {
        ServiceEvent::Ignored { reason } => {
            reason.contains("is refused") && reason.contains("raise `devices_max`")
        }
        _ => false,
    };
    simulate(&network, &mut ground, &mut drones, |events, _| count(events, is_refused) > 0);
    assert_eq!(fs::read_dir(folder.path().join("models")).unwrap().count(), 2);
}

/// Twenty thousand bad messages give a few lines, and their number is told.
#[test]
fn attack_18_bad_messages_do_not_fill_the_log() {
    let folder = tempfile::tempdir().unwrap();
    let network = MemoryNetwork::new(18, Faults::NONE);
    let mut ground = open(&network, folder.path(), Expected::Anybody(AT_ONCE));
    let mut stranger = network.join_all();
    let device = DeviceId::new("agent-1").unwrap();
    let header = |number: u64| ModelHeader {
        body_bytes: 1 << 30,
        splats: 60_000_000,
        blake3: BodyHash([7; 32]),
        chunk_bytes: 65_536,
        model: ModelId(number),
        ..Offer::new(device, ModelId(1), ModelKind::Local, 3, &model(2, 0, 1.0).splats, &[]).unwrap().header
    };
    let too_large = header(1);
    too_large.check().unwrap();
    let site = cosurf_wire::SiteId::new("test").unwrap();
    let mut events = Vec::new();
    for i in 0..20_000u64 {
        let topic = Topic::LocalHeader { device, model: ModelId(i) }.to_text(&site);
        let payload = match i % 2 {
            0 => vec![7; 9],
            _ => {
                let message = Message::Header(ModelHeader { model: ModelId(i), ..too_large });
                message.encode(&mut [0; MAX_CONTROL_BYTES]).unwrap().to_vec()
            }
        };
        while stranger
            .publish(&Outgoing { topic: topic.clone(), payload: payload.clone(), retain: false })
            .is_err()
        {
            while stranger.poll(Duration::ZERO).is_some() {}
            step(&network, &mut ground, &mut [], &mut events);
        }
    }
    let end = network.now() + Duration::from_secs(61);
    while network.now() < end {
        while stranger.poll(Duration::ZERO).is_some() {}
        step(&network, &mut ground, &mut [], &mut events);
    }
    let lines: Vec<String> = events.iter().map(ToString::to_string).collect();
    assert!(lines.len() < 20 * (1 + end.as_secs() as usize / 60), "{} lines", lines.len());
    assert!(lines.iter().any(|line| line.contains("more messages like these from agent-1")), "{lines:?}");
}

/// However many models a device sends, only a few revisions of the global model are kept.
#[test]
fn attack_18_a_device_that_sends_many_models_does_not_fill_the_disk_with_revisions() {
    let folder = tempfile::tempdir().unwrap();
    let network = MemoryNetwork::new(18, Faults::NONE);
    let mut ground = open(&network, folder.path(), Expected::Anybody(AT_ONCE));
    let merged = |events: &[ServiceEvent], _: &[Drone]| count(events, is_merged) == 1;
    for number in 1..=10 {
        let mut drones = vec![Drone::new(&network, "agent-1", number, &model(20 + number as usize, 0, 2.0))];
        simulate(&network, &mut ground, &mut drones, merged);
        network.leave(drones.remove(0).transport);
    }
    let revisions = fs::read_dir(folder.path().join("global")).unwrap().count();
    assert_eq!(revisions, super::super::keeper::REVISIONS_KEPT);
}
