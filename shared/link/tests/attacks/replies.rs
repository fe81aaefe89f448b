//! Forged and repeated replies and headers, where keys are in use.

use std::time::Duration;

use cosurf_link::{InboxLimits, ModelKey, Node, NodeEvent, Offer, Role, Uploader};
use cosurf_tests::fleet::{Member, run_until};
use cosurf_tests::offers::offer;
use cosurf_tests::stranger::Stranger;
use cosurf_wire::message::{Chunk, Done, Refused};
use cosurf_wire::{DeviceId, Message, ModelHeader, ModelId, ModelKind, RefusalReason, Reply, TileId, Topic};

use crate::site::{
    drone_credentials, ground_credentials, is_refused, keyed_site, network, pass, sealed_by, slow_network,
};

const MINUTE: Duration = Duration::from_secs(60);

fn local(model: u64) -> Offer {
    offer("drone-1", model, ModelKind::Local, 1, 3000, 4096)
}

fn device(name: &str) -> DeviceId {
    DeviceId::new(name).unwrap()
}

fn done(of: &ModelHeader, session: u64) -> Message<'static> {
    Message::Done(Done { device: of.device, model: of.model, session, blake3: of.blake3 })
}

fn reply_topic(reply: Reply) -> Topic {
    Topic::LocalReply { device: device("drone-1"), reply }
}

/// A `Done` ends an upload only if a listed aggregator has signed it for this session.
#[test]
fn attack_03_a_forged_done_does_not_end_an_upload() {
    let network = network();
    let mut fleet = keyed_site(&network);
    let mut stranger = Stranger::new(&network);
    let offer = local(1);
    fleet[1].node.upload(offer.clone());
    let ground = fleet.remove(0); // the aggregator does not listen yet
    network.leave(ground.transport);
    pass(&network, &mut fleet, &mut stranger, Duration::from_secs(1));
    let session = fleet[0].identity.session;
    let (header, topic) = (offer.header, reply_topic(Reply::Done));
    stranger.say(topic, &done(&header, session));
    stranger.say(topic, &done(&header, 0));
    for name in ["stranger", "drone-1", "drone-2"] {
        let (topic, payload) = sealed_by(name, 9, 9, topic, &done(&header, session));
        stranger.say_bytes(&topic, payload);
    }
    // What the aggregator has signed for an earlier session, and for another topic.
    let (text, payload) = sealed_by("ground", 9, 9, topic, &done(&header, session - 1));
    stranger.say_bytes(&text, payload);
    let elsewhere = Topic::LocalReply { device: device("drone-2"), reply: Reply::Done };
    let (_, payload) = sealed_by("ground", 9, 9, elsewhere, &done(&header, session));
    stranger.say_bytes(&text, payload);
    pass(&network, &mut fleet, &mut stranger, Duration::from_secs(1));
    assert!(fleet[0].uploaded.is_empty(), "a forged Done has ended the upload");
    assert!(fleet[0].node.forged() >= 5, "{} are counted", fleet[0].node.forged());
    // The aggregator comes back, and its own `Done` ends it.
    fleet.push(Member::new(&network, Role::Aggregator, "ground", InboxLimits::default()));
    fleet[2].node.set_credentials(ground_credentials());
    run_until(&network, &mut fleet, MINUTE, |fleet| !fleet[0].uploaded.is_empty());
    assert_eq!(fleet[2].disk[&ModelKey::from(header)].1, offer.body);
}

/// A repeated `Done` of an earlier session does not end the upload of the same model, which the aggregator has forgotten.
#[test]
fn attack_03_a_recorded_done_does_not_end_the_next_session() {
    let network = network();
    let mut fleet = keyed_site(&network);
    let mut stranger = Stranger::new(&network);
    fleet[1].node.upload(local(1));
    run_until(&network, &mut fleet, MINUTE, |fleet| !fleet[1].uploaded.is_empty());
    stranger.listen();
    let recorded = stranger.heard_on("/drone-1/dn/done");
    assert!(!recorded.is_empty());
    let ground = fleet.remove(0);
    network.leave(ground.transport);
    let drone = &mut fleet[0];
    drone.restart(&network);
    drone.node.set_credentials(drone_credentials("drone-1"));
    drone.uploaded.clear();
    drone.node.upload(local(1));
    pass(&network, &mut fleet, &mut stranger, Duration::from_secs(1));
    for (topic, payload) in recorded {
        stranger.say_bytes(&topic, payload);
    }
    pass(&network, &mut fleet, &mut stranger, Duration::from_secs(1));
    assert!(fleet[0].uploaded.is_empty());
}

/// Neither forged refusals nor forged headers make a device give up.
#[test]
fn attack_04_unsigned_headers_and_refusals_do_not_stop_a_device() {
    let network = network();
    let mut fleet = keyed_site(&network);
    let mut stranger = Stranger::new(&network);
    let offer = local(1);
    let (header, topic) = (offer.header, Topic::LocalHeader { device: device("drone-1"), model: ModelId(1) });
    fleet[1].node.upload(offer.clone());
    let refused =
        |reason| Message::Refused(Refused { device: header.device, model: header.model, session: 7, reason });
    // Nine bytes of another version: its number, four bytes, and their checksum.
    let mut other = vec![2, 5, 9, 9, 9];
    other.extend(crc32fast::hash(&other).to_le_bytes());
    let text = topic.to_text(&cosurf_wire::SiteId::new("site").unwrap());
    run_until(&network, &mut fleet, MINUTE, |fleet| {
        stranger.say(topic, &Message::Header(header));
        stranger.say(topic, &Message::Header(ModelHeader { chunk_bytes: 1024, ..header }));
        stranger.say_bytes(&text, other.clone());
        for reason in [RefusalReason::Withdrawn, RefusalReason::NumberTaken, RefusalReason::Busy] {
            stranger.say(reply_topic(Reply::Refused), &refused(reason));
        }
        let (text, payload) =
            sealed_by("drone-2", 7, 1, reply_topic(Reply::Refused), &refused(RefusalReason::TooLarge));
        stranger.say_bytes(&text, payload);
        stranger.listen();
        !fleet[1].uploaded.is_empty()
    });
    assert!(!is_refused(&fleet[1]), "the device was refused");
    assert!(fleet[0].node.forged() > 0 && fleet[1].node.forged() > 0);
    let refusals = stranger.heard_on("/drone-1/dn/refused");
    let is_from_ground = |(_, payload): &&(String, Vec<u8>)| {
        cosurf_wire::Sealed::decode(payload)
            .is_ok_and(|sealed| sealed.seal.is_some_and(|seal| seal.sender == device("ground")))
    };
    assert_eq!(refusals.iter().filter(is_from_ground).count(), 0, "the aggregator itself has refused it");
    assert_eq!(fleet[0].disk[&ModelKey::from(header)].1, offer.body);
}

/// A global model is delivered only when its own receivers have signed that they have it.
#[test]
fn attack_05_a_forged_global_done_delivers_nothing() {
    let network = network();
    let mut fleet = keyed_site(&network);
    let mut stranger = Stranger::new(&network);
    let offer = offer("ground", 1, ModelKind::Global, 1, 3000, 4096);
    let header = offer.header;
    let receivers = [device("drone-1"), device("drone-2")];
    fleet[0].node.broadcast(TileId::WHOLE, offer.clone(), &receivers);
    let topics = receivers.map(|device| Topic::GlobalReply { device, reply: Reply::Done });
    for topic in topics {
        stranger.say(topic, &done(&header, 7));
        // drone-2 says it in the name of drone-1.
        let (text, payload) = sealed_by("drone-2", 7, 1000, topics[0], &done(&header, 7));
        stranger.say_bytes(&text, payload);
    }
    run_until(&network, &mut fleet, MINUTE, |fleet| {
        let have = fleet[1..].iter().filter(|drone| !drone.disk.is_empty()).count();
        assert!(have == 2 || fleet[0].uploaded.is_empty(), "{have} drones have it");
        !fleet[0].uploaded.is_empty()
    });
    assert!(fleet[0].node.forged() >= 3);
}

/// With keys, only the aggregator's own global model is taken: not one of a stranger, and not one that a drone has signed.
#[test]
fn attack_12_a_global_model_of_a_stranger_is_not_taken() {
    let network = network();
    let mut fleet = keyed_site(&network);
    let mut stranger = Stranger::new(&network);
    let forged = offer("ground", 1_000_000, ModelKind::Global, 2, 100, 4096).header;
    let (topic, message) = (Topic::GlobalHeader { tile: TileId::WHOLE }, Message::Header(forged));
    stranger.say(topic, &message);
    let (text, payload) = sealed_by("drone-2", 7, 1, topic, &message);
    stranger.say_bytes(&text, payload);
    pass(&network, &mut fleet, &mut stranger, Duration::from_secs(1));
    let is_taken = |event: &NodeEvent| matches!(event, NodeEvent::Receiving(_));
    assert!(fleet[1..].iter().all(|drone| !drone.events.iter().any(is_taken) && drone.node.forged() == 2));
    fleet[0].node.broadcast(
        TileId::WHOLE,
        offer("ground", 1, ModelKind::Global, 1, 500, 4096),
        &[device("drone-1")],
    );
    run_until(&network, &mut fleet, MINUTE, |fleet| {
        stranger.listen();
        !fleet[0].uploaded.is_empty()
    });
}

/// A stranger deletes the retained offer of the global model. A drone that comes later gets the model all the same.
#[test]
fn attack_12_a_deleted_offer_of_the_global_model_is_repeated() {
    let network = network();
    let mut fleet = keyed_site(&network);
    let mut stranger = Stranger::new(&network);
    let late = fleet.remove(2);
    network.leave(late.transport);
    let topic = Topic::GlobalHeader { tile: TileId::WHOLE };
    let offer = offer("ground", 1, ModelKind::Global, 1, 500, 4096);
    fleet[0].node.broadcast(TileId::WHOLE, offer, &[device("drone-1")]);
    run_until(&network, &mut fleet, MINUTE, |fleet| !fleet[0].uploaded.is_empty());
    stranger.delete(topic);
    pass(&network, &mut fleet, &mut stranger, Duration::from_secs(1));
    let begun = network.now();
    fleet.push(Member::new(&network, Role::Device, "drone-2", InboxLimits::default()));
    fleet[2].node.set_credentials(drone_credentials("drone-2"));
    run_until(&network, &mut fleet, begun + Duration::from_secs(5), |fleet| {
        stranger.listen();
        !fleet[2].disk.is_empty()
    });
    // Drones that come all the time do not make the aggregator repeat it all the time.
    stranger.heard.clear();
    for _ in 0..500 {
        fleet[2].restart(&network);
        fleet[2].node.set_credentials(drone_credentials("drone-2"));
        pass(&network, &mut fleet, &mut stranger, Duration::from_millis(20));
    }
    let offers = stranger.heard_on("/global/whole/m").len();
    assert!((5..=12).contains(&offers), "{offers} offers in 10 s");
}

/// A listed drone that refuses the global model again and again does not keep its offer from the others.
#[test]
fn attack_12_refusals_of_one_drone_do_not_postpone_the_offer_to_the_others() {
    let site = cosurf_wire::SiteId::new("site").unwrap();
    let offer = offer("ground", 1, ModelKind::Global, 1, 500, 4096);
    let header = offer.header;
    let receivers = ["drone-1", "drone-2"].map(device);
    let mut uploader = Uploader::global(site, TileId::WHOLE, offer, &receivers);
    let topic = Topic::GlobalReply { device: device("drone-2"), reply: Reply::Refused };
    let reason = RefusalReason::StoreFailed;
    let refused = Refused { device: header.device, model: header.model, session: 7, reason };
    let mut offers = 0;
    for now in (0..200).map(|i| Duration::from_millis(i * 100)) {
        offers += std::iter::from_fn(|| uploader.next(now)).count();
        uploader.on_reply(now, &topic, &Message::Refused(refused));
    }
    assert!((3..20).contains(&offers), "{offers} offers in 20 s");
}

/// Headers of strangers in the place of the genuine ones, again and again, do not stall a transfer.
#[test]
fn attack_13_swapped_headers_do_not_stall_an_upload() {
    let swap = |network: &cosurf_link::MemoryNetwork, fleet: &mut [Member], stranger: &mut Stranger| {
        let header = local(1).header;
        let topic = Topic::LocalHeader { device: header.device, model: header.model };
        fleet[1].node.upload(local(1));
        let mut sizes = [1024, 2048, 8192, 65_536].into_iter().cycle();
        run_until(network, fleet, MINUTE, |fleet| {
            // Once the genuine header has arrived, others come between all messages.
            let is_begun = fleet[0].events.iter().any(|event| matches!(event, NodeEvent::Receiving(_)));
            let swapped = ModelHeader { chunk_bytes: sizes.next().unwrap(), ..header };
            if is_begun {
                stranger.say(topic, &Message::Header(swapped));
                stranger
                    .say(topic, &Message::Header(offer("drone-1", 1, ModelKind::Local, 2, 50, 4096).header));
            }
            stranger.listen();
            !fleet[1].uploaded.is_empty()
        });
        assert!(network.now() < Duration::from_secs(15), "{:?}", network.now());
    };
    let network_a = slow_network();
    let mut fleet = keyed_site(&network_a);
    swap(&network_a, &mut fleet, &mut Stranger::new(&network_a));
    // Without keys too, once the transfer has begun.
    let network_b = slow_network();
    let mut fleet = crate::site::open_site(&network_b, InboxLimits::default(), &["drone-1"]);
    swap(&network_b, &mut fleet, &mut Stranger::new(&network_b));
}

/// A recorded header of an earlier session does not redirect the replies.
#[test]
fn attack_13_a_recorded_header_does_not_redirect_the_replies() {
    let network = network();
    let mut fleet = keyed_site(&network);
    let mut stranger = Stranger::new(&network);
    let ground = fleet.remove(0);
    network.leave(ground.transport);
    fleet[0].node.upload(local(1));
    pass(&network, &mut fleet, &mut stranger, Duration::from_millis(100));
    let recorded = stranger.heard_on("/drone-1/up/1/m");
    fleet[0].restart(&network);
    fleet[0].node.set_credentials(drone_credentials("drone-1"));
    fleet[0].node.upload(local(1));
    fleet.insert(0, Member::new(&network, Role::Aggregator, "ground", InboxLimits::default()));
    fleet[0].node.set_credentials(ground_credentials());
    run_until(&network, &mut fleet, MINUTE, |fleet| {
        for (topic, payload) in &recorded {
            stranger.say_bytes(topic, payload.clone());
        }
        stranger.listen();
        !fleet[1].uploaded.is_empty()
    });
    assert!(network.now() < Duration::from_secs(5), "{:?}", network.now());
}

/// Chunks of a stranger, which nobody signs, spoil no model for good.
#[test]
fn attack_04_junk_chunks_do_not_make_a_device_give_up() {
    let network = slow_network();
    let mut fleet = keyed_site(&network);
    let mut stranger = Stranger::new(&network);
    let offer = local(1);
    let header = offer.header;
    fleet[1].node.upload(offer.clone());
    run_until(&network, &mut fleet, 5 * MINUTE, |fleet| {
        if network.now() < MINUTE && fleet[0].node.unfinished_bytes() > 0 {
            let (device, model, index) = (header.device, header.model, header.chunks() - 2);
            let chunk = Chunk { device, model, index, payload: &[7; 4096] };
            let topic = Topic::LocalChunk { device, model, index };
            stranger.say(topic, &Message::Chunk(chunk));
        }
        stranger.listen();
        let is_final = |event: &NodeEvent| matches!(event, NodeEvent::UploadRefused { reason, .. } if !reason.is_temporary());
        assert!(!fleet[1].events.iter().any(is_final), "the device gives up");
        !fleet[1].uploaded.is_empty()
    });
    assert!(is_refused(&fleet[1]), "the junk has spoilt nothing, so the test shows nothing");
    assert_eq!(fleet[0].disk[&ModelKey::from(header)].1, offer.body);
}

/// A device that is not listed is told nothing, but tells its operator that nobody replies.
#[test]
fn attack_04_an_unsigned_device_is_answered_with_silence() {
    let network = network();
    let mut fleet = keyed_site(&network);
    let identity = fleet[1].identity;
    fleet[1].node = Node::new(identity, InboxLimits::default(), &[]); // without a key
    fleet[1].node.upload(local(1));
    let mut stranger = Stranger::new(&network);
    run_until(&network, &mut fleet, 2 * MINUTE, |fleet| {
        stranger.listen();
        fleet[1].events.iter().any(|event| matches!(event, NodeEvent::Unanswered { offers: 5, .. }))
    });
    assert!(stranger.heard.iter().all(|(topic, _)| !topic.contains("/drone-1/dn/")), "{:?}", stranger.heard);
    assert!(fleet[0].disk.is_empty());
}

/// A drone whose clock was ahead, and whose folder is new, is not believed; the aggregator is told why. So it is if somebody
/// repeats an old offer.
#[test]
fn an_offer_of_an_earlier_session_is_told() {
    let network = network();
    let mut fleet = keyed_site(&network);
    let mut stranger = Stranger::new(&network);
    for (number, session) in [(1, 5000), (2, 4000), (3, 6000)] {
        fleet[1].identity.session = session - 1;
        fleet[1].restart(&network);
        fleet[1].node.set_credentials(drone_credentials("drone-1"));
        fleet[1].node.upload(offer("drone-1", number, ModelKind::Local, 1, 900, 2048));
        pass(&network, &mut fleet, &mut stranger, Duration::from_secs(20));
        let is_older = |event: &NodeEvent| matches!(event, NodeEvent::OlderSession { heard: 5000, .. });
        let told = fleet[0].events.drain(..).filter(is_older).count();
        assert_eq!(told > 0, session == 4000, "{session}: told {told} times");
    }
    let stored: Vec<u64> = fleet[0].disk.keys().map(|key| key.model.0).collect();
    assert_eq!(stored, [1, 3]);
}
