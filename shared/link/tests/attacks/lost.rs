//! A model that the aggregator has acknowledged and lost.

use std::time::Duration;

use cosurf_link::{InboxLimits, ModelKey, NodeEvent};
use cosurf_tests::fleet::{Member, run_until};
use cosurf_tests::offers::offer;
use cosurf_tests::stranger::Stranger;
use cosurf_wire::message::Want;
use cosurf_wire::{Message, Missing, ModelKind, Reply, Topic};

use crate::site::{keyed_site, network, open_site, pass};

const MINUTE: Duration = Duration::from_secs(60);

fn asked(device: &Member) -> usize {
    device.events.iter().filter(|event| matches!(event, NodeEvent::AskedAgain(_))).count()
}

/// Uploads a model, makes the aggregator lose it, and waits until it is stored again.
fn lose_and_find(network: &cosurf_link::MemoryNetwork, fleet: &mut [Member]) -> ModelKey {
    let offer = offer("drone-1", 1, ModelKind::Local, 1, 20_000, 2048);
    let key = ModelKey::from(&offer.header);
    fleet[1].node.upload(offer);
    run_until(network, fleet, MINUTE, |fleet| fleet[1].uploaded.len() == 1);
    let before = fleet[0].disk.remove(&key).unwrap();
    fleet[0].node.ask_again(key);
    run_until(network, fleet, MINUTE, |fleet| fleet[1].uploaded.len() == 2);
    assert!(fleet[0].disk.get(&key) == Some(&before), "other bytes");
    assert_eq!((asked(&fleet[1]), asked(&fleet[2])), (1, 0));
    key
}

#[test]
fn a_device_that_is_there_serves_a_lost_model_again() {
    let network = network();
    lose_and_find(&network, &mut keyed_site(&network));
    let network = crate::site::network();
    lose_and_find(&network, &mut open_site(&network, InboxLimits::default(), &["drone-1", "drone-2"]));
}

/// The aggregator asks as long as it takes. A device that was away offers its model as it comes back.
#[test]
fn a_device_that_comes_back_serves_a_lost_model_again() {
    let network = network();
    let mut fleet = keyed_site(&network);
    let offer = offer("drone-1", 1, ModelKind::Local, 1, 20_000, 2048);
    let key = ModelKey::from(&offer.header);
    fleet[1].node.upload(offer.clone());
    run_until(&network, &mut fleet, MINUTE, |fleet| fleet[1].uploaded.len() == 1);
    fleet[0].disk.remove(&key);
    fleet[1].restart(&network);
    fleet[1].node.set_credentials(crate::site::drone_credentials("drone-1"));
    fleet[0].node.ask_again(key);
    fleet[1].node.upload(offer);
    run_until(&network, &mut fleet, MINUTE, |fleet| fleet[1].uploaded.len() == 2);
    assert!(fleet[0].disk.contains_key(&key));
}

/// Where keys are in use, only the aggregator can ask. A stranger that repeats its request is ignored too.
#[test]
fn a_stranger_cannot_ask_for_a_model_again() {
    let network = network();
    let mut fleet = keyed_site(&network);
    let mut stranger = Stranger::new(&network);
    let offer = offer("drone-1", 1, ModelKind::Local, 1, 20_000, 2048);
    let key = ModelKey::from(&offer.header);
    fleet[1].node.upload(offer);
    pass(&network, &mut fleet, &mut stranger, MINUTE);
    fleet[0].disk.remove(&key);
    fleet[0].node.ask_again(key);
    pass(&network, &mut fleet, &mut stranger, MINUTE);
    assert_eq!((fleet[1].uploaded.len(), asked(&fleet[1])), (2, 1));
    let topic = Topic::LocalReply { device: key.device, reply: Reply::Want };
    let session = fleet[1].identity.session;
    let ModelKey { device, model } = key;
    for _ in 0..20 {
        let want = Want { device, model, session, idle: true, missing: Missing::all() };
        stranger.say(topic, &Message::Want(want));
        for (topic, payload) in stranger.heard.clone() {
            if topic.ends_with("/dn/want") {
                stranger.say_bytes(&topic, payload);
            }
        }
        pass(&network, &mut fleet, &mut stranger, Duration::from_secs(1));
    }
    assert_eq!(asked(&fleet[1]), 1);
}
