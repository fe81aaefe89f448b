//! Numbers of models that a drone does not expect.

use std::time::Duration;

use cosurf_link::{InboxLimits, MemoryNetwork, ModelKey, NodeEvent};
use cosurf_tests::fleet::{Member, run_until};
use cosurf_tests::offers::offer;
use cosurf_tests::stranger::Stranger;
use cosurf_wire::message::Refused;
use cosurf_wire::{DeviceId, Message, ModelId, ModelKind, RefusalReason, Reply, Topic};

use crate::site::{drone_credentials, keyed_site, network, open_site, pass};

const MINUTE: Duration = Duration::from_secs(60);

/// Sends a model of `drone-1`, from a folder that it has lost, until the aggregator has it; returns its number.
fn send_anew(network: &MemoryNetwork, fleet: &mut [Member], splats: usize) -> ModelId {
    fleet[1].restart(network);
    fleet[1].node.upload(offer("drone-1", 1, ModelKind::Local, 1, splats, 2048));
    fleet[1].events.clear();
    let mut number = ModelId(1);
    let before = fleet[1].uploaded.len();
    run_until(network, fleet, MINUTE, |fleet| {
        let refused = fleet[1].events.drain(..).find_map(|event| match event {
            NodeEvent::UploadRefused { key, .. } if key.model == number => Some(key),
            _ => None,
        });
        number = refused.map_or(number, |key| fleet[1].node.renumber(key).expect("another number"));
        fleet[1].uploaded.len() > before
    });
    number
}

/// Whatever number somebody has used in the drone's name where nobody signs, and whatever the drone has sent before: its
/// next model gets a higher one, as long as that is within reach.
#[test]
fn attack_09_a_drone_that_has_lost_its_folder_is_not_banned() {
    for taken in [1, 2, 700, (1 << 40) - 1] {
        let network = network();
        let mut fleet = open_site(&network, InboxLimits::default(), &["drone-1"]);
        fleet[1].node.upload(offer("drone-1", taken, ModelKind::Local, 1, 900, 2048));
        run_until(&network, &mut fleet, MINUTE, |fleet| !fleet[1].uploaded.is_empty());
        let number = send_anew(&network, &mut fleet, 1000);
        assert!(number.0 > taken && number.0 <= 2 * taken.max(8), "{number} for {taken}");
        let device = DeviceId::new("drone-1").unwrap();
        assert!(fleet[0].disk.contains_key(&ModelKey { device, model: number }));
        // Nothing retained is left of the numbers that were refused.
        let mut stranger = Stranger::new(&network);
        pass(&network, &mut fleet, &mut stranger, Duration::from_secs(5));
        assert!(stranger.heard.iter().all(|(topic, _)| !topic.ends_with("/m")), "{taken}");
    }
}

#[test]
fn a_drone_with_a_key_is_not_banned_either() {
    let network = network();
    let mut fleet = keyed_site(&network);
    fleet[1].node.upload(offer("drone-1", 700, ModelKind::Local, 1, 900, 2048));
    run_until(&network, &mut fleet, MINUTE, |fleet| !fleet[1].uploaded.is_empty());
    fleet[1].restart(&network);
    fleet[1].node.set_credentials(drone_credentials("drone-1"));
    fleet[1].node.upload(offer("drone-1", 1, ModelKind::Local, 1, 1000, 2048));
    fleet[1].events.clear();
    run_until(&network, &mut fleet, MINUTE, |fleet| {
        let refused: Vec<ModelKey> = fleet[1]
            .events
            .drain(..)
            .filter_map(|event| match event {
                NodeEvent::UploadRefused { key, reason: RefusalReason::Replayed, .. } => Some(key),
                _ => None,
            })
            .collect();
        refused.into_iter().for_each(|key| assert!(fleet[1].node.renumber(key).is_some()));
        fleet[1].uploaded.len() == 2
    });
    assert!(fleet[0].disk.keys().any(|key| key.model == ModelId(1024)));
}

/// Where nobody signs, a stranger can refuse every number. The drone gives up before it has used up its numbers.
#[test]
fn attack_04_forged_refusals_do_not_use_up_the_numbers() {
    let network = network();
    let mut fleet = open_site(&network, InboxLimits::default(), &["drone-1"]);
    let ground = fleet.remove(0); // it would store the model
    network.leave(ground.transport);
    fleet[0].node.upload(offer("drone-1", 1, ModelKind::Local, 1, 900, 2048));
    let mut stranger = Stranger::new(&network);
    let device = DeviceId::new("drone-1").unwrap();
    let topic = Topic::LocalReply { device, reply: Reply::Refused };
    let mut numbers = vec![ModelId(1)];
    while let Some(model) = numbers.last().copied() {
        let reason = RefusalReason::NumberTaken;
        stranger.say(topic, &Message::Refused(Refused { device, model, session: 0, reason }));
        pass(&network, &mut fleet, &mut stranger, Duration::from_millis(100));
        let refused = fleet[0].events.drain(..).any(|event| matches!(event, NodeEvent::UploadRefused { .. }));
        assert!(refused, "{model} is not offered");
        match fleet[0].node.renumber(ModelKey { device, model }) {
            Some(next) => numbers.push(next),
            None => break,
        }
        assert!(numbers.len() < 100, "no end: {numbers:?}");
    }
    assert!(numbers.len() > 40 && numbers.last().unwrap().0 < 1 << 50, "{numbers:?}");
}

/// However often a drone loses its folder, its numbers follow the clock.
#[test]
fn a_drone_that_loses_its_folder_again_and_again_does_not_use_up_its_numbers() {
    let network = network();
    let mut fleet = open_site(&network, InboxLimits::default(), &["drone-1"]);
    let start = 1_800_000_000;
    fleet[1].node.upload(offer("drone-1", 1, ModelKind::Local, 1, 900, 2048));
    run_until(&network, &mut fleet, MINUTE, |fleet| !fleet[1].uploaded.is_empty());
    for flight in 0..100 {
        fleet[1].identity.session = start + 60 * flight as u64;
        let number = send_anew(&network, &mut fleet, 901 + flight);
        assert!(number.0 >= start && number.0 < start + 7000, "flight {flight}: {number}");
    }
}
