//! A model that the aggregator has acknowledged and lost.

use std::time::Duration;

use cosurf_link::{InboxLimits, MemoryNetwork, ModelKey, NodeEvent};
use cosurf_tests::fleet::{Member, run_until};
use cosurf_tests::offers::offer;
use cosurf_tests::stranger::Stranger;
use cosurf_wire::message::{Done, Want};
use cosurf_wire::{DeviceId, Message, Missing, ModelKind, Reply, TileId, Topic};

use crate::site::{keyed_site, network, open_site, pass};

const MINUTE: Duration = Duration::from_secs(60);

fn asked(device: &Member) -> usize {
    device.events.iter().filter(|event| matches!(event, NodeEvent::AskedAgain { .. })).count()
}

/// Uploads a model, makes the aggregator lose it, and waits until it is stored again.
fn lose_and_find(network: &MemoryNetwork, fleet: &mut [Member]) -> ModelKey {
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

/// An aggregator that has lost everything, its records too, cannot ask. A device that is still there finds out.
#[test]
fn a_device_offers_its_stored_model_again_now_and_then() {
    let network = network();
    let mut fleet = open_site(&network, InboxLimits::default(), &["drone-1"]);
    let offer = offer("drone-1", 1, ModelKind::Local, 1, 20_000, 2048);
    let key = ModelKey::from(&offer.header);
    fleet[1].node.upload(offer);
    run_until(&network, &mut fleet, MINUTE, |fleet| fleet[1].uploaded.len() == 1);
    let before = fleet[0].disk.remove(&key).unwrap();
    fleet[0].restart(&network);
    run_until(&network, &mut fleet, 2 * MINUTE, |fleet| fleet[0].disk.contains_key(&key));
    assert!(fleet[0].disk.get(&key) == Some(&before), "other bytes");
    assert_eq!(asked(&fleet[1]), 1);
    // Afterwards, nothing is sent but an offer a minute and its answer.
    let mut stranger = Stranger::new(&network);
    pass(&network, &mut fleet, &mut stranger, 3 * MINUTE);
    assert_eq!((asked(&fleet[1]), fleet[0].stored_twice), (1, 0));
    let heard = stranger.heard.iter().filter(|(topic, _)| !topic.ends_with("/state")).count();
    assert!((4..12).contains(&heard), "{heard}");
}

/// Offers a global model until both drones have it. Returns its key.
fn deliver(network: &MemoryNetwork, fleet: &mut [Member]) -> ModelKey {
    let offer = offer("ground", 1, ModelKind::Global, 1, 20_000, 2048);
    let key = ModelKey::from(&offer.header);
    let receivers = ["drone-1", "drone-2"].map(|name| DeviceId::new(name).unwrap());
    fleet[0].node.broadcast(TileId::WHOLE, offer, &receivers);
    run_until(network, fleet, MINUTE, |fleet| !fleet[0].uploaded.is_empty());
    key
}

/// A drone whose folder is gone gets the same revision of the global model again, and no other drone does.
#[test]
fn a_device_that_has_lost_the_global_model_gets_it_again() {
    let keyed = |network: &MemoryNetwork| keyed_site(network);
    let open = |network: &MemoryNetwork| open_site(network, InboxLimits::default(), &["drone-1", "drone-2"]);
    for (is_keyed, site) in [(true, &keyed as &dyn Fn(&MemoryNetwork) -> Vec<Member>), (false, &open)] {
        let network = network();
        let mut fleet = site(&network);
        let key = deliver(&network, &mut fleet);
        let before = fleet[1].disk.remove(&key).unwrap();
        fleet[1].restart(&network);
        if is_keyed {
            fleet[1].node.set_credentials(crate::site::drone_credentials("drone-1"));
        }
        run_until(&network, &mut fleet, MINUTE, |fleet| fleet[1].disk.contains_key(&key));
        assert!(fleet[1].disk.get(&key) == Some(&before), "other bytes");
        assert_eq!((asked(&fleet[0]), fleet[2].stored_twice), (1, 0));
    }
}

/// Who says again and again that the model is lost gets it once in half a minute.
#[test]
fn attack_08_forged_losses_are_not_amplified() {
    let network = network();
    let mut fleet = open_site(&network, InboxLimits::default(), &["drone-1", "drone-2"]);
    let ModelKey { device, model } = deliver(&network, &mut fleet);
    let header = fleet[1].disk.values().next().unwrap().0;
    let (body, blake3) = (header.body_bytes as usize, header.blake3);
    let mut stranger = Stranger::new(&network);
    let victim = DeviceId::new("drone-1").unwrap();
    for _ in 0..1000 {
        let want = Want { device, model, session: 0, idle: true, missing: Missing::all() };
        stranger.say(Topic::GlobalReply { device: victim, reply: Reply::Want }, &Message::Want(want));
        pass(&network, &mut fleet, &mut stranger, Duration::from_millis(40));
        let done = Done { device, model, session: 0, blake3 };
        stranger.say(Topic::GlobalReply { device: victim, reply: Reply::Done }, &Message::Done(done));
        pass(&network, &mut fleet, &mut stranger, Duration::from_millis(20));
    }
    let chunks = stranger.heard.iter().filter(|(topic, _)| topic.contains("/c/"));
    let sent: usize = chunks.map(|(_, payload)| payload.len()).sum();
    // Twice in a minute, each time what the window holds at most.
    assert!(sent > 0 && sent < 3 * body, "{sent} bytes of {body}");
}
