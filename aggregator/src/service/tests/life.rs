//! Random histories of a site, each from a seed. Models arrive in any order, late, duplicated, and in new versions. The
//! service is killed while it waits or merges. A device is withdrawn. Every history with the same final models must end
//! with the bytes of a direct merge of these models.

use cosurf_link::{FirstLayer, model_to_body, plain_importance};
use cosurf_scene::LocalFrame;
use cosurf_tests::dice::Dice;
use cosurf_wire::BodyHash;

use super::super::keeper::Keeper;
use super::*;
use crate::merge::{InMemory, MergeProgress, Resources, Tiles, merge};
use crate::testing::{QUICK, model_at};

/// Number of histories.
const SEEDS: u64 = 200;
const NAMES: [&str; 3] = ["agent-1", "agent-2", "agent-3"];
/// A device that flies in some histories, and is withdrawn in all.
const STRANGER: &str = "agent-0";
const SETTINGS: MergeSettings = MergeSettings { seed: 3, ..QUICK };

/// The models that count in the end.
fn models() -> Vec<Model> {
    [-2.0, 0.0, 2.0].map(model_at).to_vec()
}

/// A model as it arrives, encoded and decoded.
fn arrived(model: &Model) -> Model {
    let Model { splats, cameras } = model;
    body_to_model(
        &model_to_body(
            splats,
            cameras,
            &LocalFrame::WORLD,
            FirstLayer::ByImportance(&plain_importance(splats)),
        )
        .unwrap(),
        &LocalFrame::WORLD,
    )
    .unwrap()
}

/// The hash of the global model that a direct merge of the models gives.
fn merged_hash(models: &[Model]) -> BodyHash {
    let locals = InMemory(models.iter().map(arrived).collect());
    let mut go_on = |_: MergeProgress| ControlFlow::Continue(());
    let merged = merge(
        &locals,
        &SETTINGS,
        Resources { scratch: tempfile::tempdir().unwrap().path(), tiles: Tiles::Forgotten, threads: 1 },
        &mut go_on,
    )
    .unwrap();
    let (device, body) = (
        DeviceId::new("aggregator").unwrap(),
        packed(&merged.model, &LocalFrame::WORLD, 1, &|| false).unwrap(),
    );
    Offer::from_body(device, ModelId(1), ModelKind::Global, 1, body).unwrap().header.blake3
}

/// One run of the service, until it is killed.
struct Sitting {
    /// Index into [`NAMES`] and model number of each drone. Model 1 shows another place.
    drones: Vec<(usize, u64)>,
    /// Whether [`STRANGER`] flies too. Otherwise it is withdrawn.
    with_stranger: bool,
    killed: Kill,
}

#[derive(Clone, Copy, PartialEq)]
enum Kill {
    /// The service is killed as soon as all models are stored, before or during the merge.
    BeforeOrInTheMerge,
    /// The service is killed after the merge.
    AfterTheMerge,
}

/// Draws the runs of a history. The drones come in random order. In the first run, the first drone sends an older
/// model, of another place.
fn sittings(dice: &mut Dice) -> Vec<Sitting> {
    let mut order = [0, 1, 2];
    for last in (1..3).rev() {
        order.swap(last, dice.below(last + 1));
    }
    let first = order[0];
    let together = 1 + dice.below(3);
    let mut sittings = vec![Sitting {
        drones: order[..together].iter().map(|i| (*i, if *i == first { 1 } else { 2 })).collect(),
        with_stranger: dice.coin(),
        killed: if dice.coin() { Kill::BeforeOrInTheMerge } else { Kill::AfterTheMerge },
    }];
    sittings.push(Sitting {
        drones: order.iter().map(|i| (*i, 2)).collect(),
        with_stranger: false,
        killed: Kill::AfterTheMerge,
    });
    if dice.coin() {
        let again = sittings[1].drones.clone();
        sittings[1].killed = Kill::BeforeOrInTheMerge;
        sittings.push(Sitting { drones: again, with_stranger: false, killed: Kill::AfterTheMerge });
    }
    sittings
}

/// Simulates all runs of a history and returns the hash of the last global model.
fn live(seed: u64) -> BodyHash {
    let mut dice = Dice(seed);
    let folder = tempfile::tempdir().unwrap();
    let models = models();
    let old = model_at(7.0);
    let mut global = None;
    for (number, sitting) in sittings(&mut dice).into_iter().enumerate() {
        let network = MemoryNetwork::new(10 * seed + number as u64, BAD_WEATHER);
        let model = |(i, number): (usize, u64)| if number == 1 { &old } else { &models[i] };
        let mut drones: Vec<Drone> =
            sitting.drones.iter().map(|d| Drone::new(&network, NAMES[d.0], d.1, model(*d))).collect();
        if sitting.with_stranger {
            drones.push(Drone::new(&network, STRANGER, 1, &model_at(1.0)));
        } else {
            withdraw(folder.path(), &DeviceId::new(STRANGER).unwrap()).unwrap();
        }
        let mut ground = open_with(&network, folder.path(), Expected::Anybody(AT_ONCE), SETTINGS);
        let named =
            |name: &str, model| ModelKey { device: DeviceId::new(name).unwrap(), model: ModelId(model) };
        let mut awaited: Vec<ModelKey> =
            sitting.drones.iter().map(|(i, model)| named(NAMES[*i], *model)).collect();
        awaited.extend(sitting.with_stranger.then(|| named(STRANGER, 1)));
        let here = |ground: &Ground| {
            let counted = ground.service.keeper.counted();
            awaited.iter().all(|key| counted.contains(key))
        };
        simulate_until(&network, &mut ground, &mut drones, |ground, events| match sitting.killed {
            Kill::BeforeOrInTheMerge => here(ground),
            Kill::AfterTheMerge => {
                let last = events.iter().rev().find(|event| is_merged(event) || is_stored(event));
                // A model that was stored during the merge waits for the next one.
                let is_over =
                    !ground.service.keeper.is_merging() && !ground.service.keeper.is_due(network.now());
                here(ground) && last.is_some_and(is_merged) && is_over
            }
        });
        global = ground.service.keeper.global();
    }
    global.unwrap().blake3
}

#[test]
fn every_history_ends_with_the_same_bytes() {
    let expected = merged_hash(&models());
    for seed in 0..SEEDS {
        assert_eq!(live(seed), expected, "seed {seed}");
    }
}

#[test]
fn other_models_end_with_other_bytes() {
    let mut others = models();
    others[1].splats.opacity_logits[0] += 0.5;
    assert_ne!(merged_hash(&others), merged_hash(&models()), "the comparison can fail");
}

/// For how long two models arrive each second, in the time of the service.
const ARRIVALS_FOR: Duration = Duration::from_secs(600);

/// A new model of each of the devices arrives.
fn arrive<const N: usize>(service: &mut Service, devices: [&str; N], number: u64, now: Duration) {
    for (name, place) in devices.into_iter().zip([0.0, 3.0, -3.0]) {
        let Model { splats, cameras } = model_at(place + number as f32 % 2.0);
        let device = DeviceId::new(name).unwrap();
        let offer = Offer::new(device, ModelId(number), ModelKind::Local, 2, &splats, &cameras).unwrap();
        let event = NodeEvent::Store { header: offer.header, body: offer.body.into() };
        service.keeper.take(&mut service.node, event, now);
    }
}

/// The time that merges take does not count here: the time of the service stands still meanwhile.
#[test]
fn models_that_arrive_each_second_for_five_minutes_get_a_revision_by_the_deadline() {
    let (quiet, deadline) = (Duration::from_secs(30), Duration::from_secs(120));
    let network = MemoryNetwork::new(4, Faults::NONE);
    let folder = tempfile::tempdir().unwrap();
    let rounds = Rounds { quorum: 2, quiet, deadline };
    let mut ground = open(&network, folder.path(), Expected::Anybody(rounds));
    let mut revisions = Vec::new();
    for second in 0..300 {
        let now = Duration::from_secs(second);
        arrive(&mut ground.service, NAMES, second + 1, now);
        let Service { node, keeper } = &mut ground.service;
        let mut work = |keeper: &mut Keeper| {
            let event = keeper.work(node, now);
            revisions.extend(event.filter(is_merged).map(|_| now));
        };
        (0..8).for_each(|_| work(keeper));
        while keeper.is_merging() {
            work(keeper);
            std::thread::yield_now();
        }
    }
    let gaps: Vec<Duration> = revisions.windows(2).map(|two| two[1] - two[0]).collect();
    let most = deadline + Duration::from_secs(1); // a round begins with the arrival after a merge
    assert!(revisions.first().is_some_and(|first| *first <= deadline), "{revisions:?}");
    assert!(revisions.len() >= 2 && gaps.iter().all(|gap| *gap <= most), "{revisions:?}");
}

#[test]
fn models_that_arrive_each_second_for_ten_minutes_do_not_keep_merges_from_ending() {
    let network = MemoryNetwork::new(3, Faults::NONE);
    let folder = tempfile::tempdir().unwrap();
    let mut ground = open(&network, folder.path(), Expected::Anybody(AT_ONCE));
    let (mut number, mut revisions, mut now) = (1, Vec::new(), Duration::ZERO);
    while now < ARRIVALS_FOR {
        arrive(&mut ground.service, ["agent-1", "agent-2"], number, now);
        let Service { node, keeper } = &mut ground.service;
        if let Some(ServiceEvent::Merged { header, .. }) = keeper.work(node, now) {
            revisions.push((header.model, number));
        }
        number += 1;
        now += Duration::from_secs(1);
        std::thread::sleep(Duration::from_millis(1));
    }
    let during = revisions.windows(2).filter(|two| two[1].1 > two[0].1 + 1).count();
    assert!(during > 0, "nothing arrived during a merge: {revisions:?}");
    assert!(revisions.len() > 2, "arrivals keep merges from ending: {revisions:?}");
}
