//! Requests that make a sender send chunks again.

use std::time::Duration;

use cosurf_link::InboxLimits;
use cosurf_tests::fleet::run_until;
use cosurf_tests::offers::offer;
use cosurf_tests::stranger::Stranger;
use cosurf_wire::message::Want;
use cosurf_wire::{DeviceId, Message, Missing, ModelKind, Reply, TileId, Topic};

use crate::site::{network, open_site, pass};

/// A thousand forged requests in the name of one drone are answered with a few bodies at most, and the other drones receive
/// none of that.
#[test]
fn attack_08_forged_wants_are_not_amplified() {
    let network = network();
    let mut fleet = open_site(&network, InboxLimits::default(), &["drone-1", "drone-2"]);
    let offer = offer("ground", 1, ModelKind::Global, 1, 20_000, 2048);
    let (header, body) = (offer.header, offer.body.len());
    let receivers = ["drone-1", "drone-2"].map(|name| DeviceId::new(name).unwrap());
    fleet[0].node.broadcast(TileId::WHOLE, offer, &receivers);
    run_until(&network, &mut fleet, Duration::from_secs(60), |fleet| !fleet[0].uploaded.is_empty());
    let mut stranger = Stranger::new(&network);
    let victim = DeviceId::new("drone-3").unwrap();
    let topic = Topic::GlobalReply { device: victim, reply: Reply::Want };
    let want = |has: u32| {
        let missing = Missing::of(header.chunks(), |index| index < has);
        Message::Want(Want { device: header.device, model: header.model, session: 0, idle: true, missing })
    };
    for i in 0..500u32 {
        stranger.say(topic, &want(if i % 2 == 0 { 0 } else { header.chunks() - 1 }));
        stranger.say(topic, &want(0));
        pass(&network, &mut fleet, &mut stranger, Duration::from_millis(20));
        stranger.listen();
    }
    let sum = |end: &str| -> usize {
        let chunks = stranger.heard.iter().filter(|(topic, _)| topic.contains(end) && topic.contains("/c/"));
        chunks.map(|(_, payload)| payload.len()).sum()
    };
    let (to_all, to_one) = (sum("/global/"), sum("/drone-3/dn/"));
    assert_eq!(to_all, 0, "all drones receive what one asks for");
    assert!(to_one > body && to_one < 4 * body, "{to_one} bytes for {} of {body} bytes", 1000);
}

/// A device's own upload: what the aggregator seems to ask for again and again.
#[test]
fn attack_08_forged_wants_do_not_make_a_device_flood_its_line() {
    let network = network();
    let mut fleet = open_site(&network, InboxLimits::default(), &["drone-1"]);
    let offer = offer("drone-1", 1, ModelKind::Local, 1, 20_000, 8192);
    let (header, body) = (offer.header, offer.body.len());
    fleet[1].node.upload(offer);
    let ground = fleet.remove(0); // it would end the upload
    network.leave(ground.transport);
    let mut stranger = Stranger::new(&network);
    let topic = Topic::LocalReply { device: header.device, reply: Reply::Want };
    for _ in 0..500 {
        let (missing, device, model) = (Missing::all(), header.device, header.model);
        stranger.say(topic, &Message::Want(Want { device, model, session: 0, idle: true, missing }));
        pass(&network, &mut fleet, &mut stranger, Duration::from_millis(20));
        stranger.listen();
    }
    let chunks = stranger.heard.iter().filter(|(topic, _)| topic.contains("/c/"));
    let sent: usize = chunks.map(|(_, payload)| payload.len()).sum();
    assert!(sent < 4 * body, "{sent} bytes of {body}");
}
