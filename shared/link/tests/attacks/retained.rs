//! What strangers leave at the broker, or delete there.

use std::time::Duration;

use cosurf_link::{
    Manifest, MemoryNetwork, ModelKey, NodeEvent, Offer, Outgoing, Receiver, TileEntry, Transport,
};
use cosurf_tests::fleet::{Member, run_until};
use cosurf_tests::offers::offer;
use cosurf_tests::stranger::Stranger;
use cosurf_wire::{
    Chunk, MAX_MESSAGE_BYTES, Message, ModelHeader, ModelId, ModelKind, SiteId, TileId, Topic,
};

use crate::site::{drone_credentials, keyed_site, network, pass, slow_network};

const MINUTE: Duration = Duration::from_secs(60);

/// Says something that the broker retains; without a message, deletes what it retains.
fn retain(network: &MemoryNetwork, topic: Topic, message: Option<&Message<'_>>) {
    let encode = |message: &Message<'_>| message.encode(&mut vec![0; MAX_MESSAGE_BYTES]).unwrap().to_vec();
    let topic = topic.to_text(&SiteId::new("site").unwrap());
    let payload = message.map_or(Vec::new(), encode);
    let mut transport = network.join_all();
    transport.publish(&Outgoing { topic, payload, retain: true }).unwrap();
    network.leave(transport);
}

fn restart(network: &MemoryNetwork, drone: &mut Member) {
    drone.restart(network);
    drone.node.set_credentials(drone_credentials(drone.identity.device.as_str()));
}

/// A retained chunk of a stranger does not come back whenever the aggregator connects.
#[test]
fn attack_04_a_retained_junk_chunk_does_not_come_back() {
    let network = slow_network();
    let mut fleet = keyed_site(&network);
    let offer = offer("drone-1", 1, ModelKind::Local, 1, 3000, 4096);
    let ModelHeader { device, model, .. } = offer.header;
    let index = offer.header.chunks() - 2;
    let junk = Message::Chunk(Chunk { device, model, index, payload: &[7; 4096] });
    retain(&network, Topic::LocalChunk { device, model, index }, Some(&junk));
    fleet[1].node.upload(offer.clone());
    let mut cut_at = Duration::from_millis(300);
    run_until(&network, &mut fleet, MINUTE, |fleet| {
        if network.now() >= cut_at {
            cut_at = network.now() + Duration::from_millis(700);
            network.stop(true);
            network.start();
        }
        assert!(!fleet[0].events.iter().any(|event| matches!(event, NodeEvent::Ignored { .. })));
        !fleet[1].uploaded.is_empty()
    });
    assert_eq!(fleet[0].disk[&ModelKey::from(offer.header)].1, offer.body);
}

/// Recorded births of earlier sessions do not make an aggregator believe in two drones of one name.
#[test]
fn recorded_births_do_not_count_again() {
    let network = network();
    let mut fleet = keyed_site(&network);
    let mut stranger = Stranger::new(&network);
    let second = Duration::from_secs(1);
    pass(&network, &mut fleet, &mut stranger, second);
    let recorded = stranger.heard_on("/drone-1/state");
    restart(&network, &mut fleet[1]);
    pass(&network, &mut fleet, &mut stranger, second);
    let states = |member: &Member| {
        member
            .events
            .iter()
            .filter(|event| matches!(event, NodeEvent::State(_) | NodeEvent::SameName(_)))
            .count()
    };
    let before = states(&fleet[0]);
    for _ in 0..5 {
        recorded.iter().for_each(|(topic, payload)| stranger.say_bytes(topic, payload.clone()));
    }
    pass(&network, &mut fleet, &mut stranger, second);
    assert_eq!(states(&fleet[0]), before);
}

/// Tiles reach a drone that has restarted, though a stranger has deleted the retained announcement of their list.
#[test]
fn a_deleted_announcement_does_not_keep_tiles_from_a_drone() {
    let network = network();
    let mut fleet = keyed_site(&network);
    let (ground, drone) = (fleet[0].identity.device, fleet[1].identity.device);
    let mut tile = offer("ground", 1, ModelKind::Global, 1, 500, 4096);
    tile.header.model = ModelId::of_tile(ModelId(1), 0);
    let ModelHeader { model, blake3, splats, body_bytes, bounds, .. } = tile.header;
    let manifest = Manifest {
        tiles: vec![TileEntry { model, blake3, splats, body_bytes, bounds }],
        receivers: vec![Receiver { device: drone, tiles: vec![0] }],
        ..Manifest::default()
    };
    let list = Offer::of_manifest(ground, ModelId(1), 3, &manifest).unwrap();
    fleet[0].node.broadcast(TileId::WHOLE, list, &[drone]);
    run_until(&network, &mut fleet, MINUTE, |fleet| !fleet[0].uploaded.is_empty());
    retain(&network, Topic::GlobalHeader { tile: TileId::WHOLE }, None);
    restart(&network, &mut fleet[1]);
    fleet[0].node.send_tile(drone, tile);
    let key = ModelKey { device: ground, model };
    run_until(&network, &mut fleet, MINUTE, |fleet| {
        let has_list = |event: &NodeEvent| matches!(event, NodeEvent::Known(header) if header.kind == ModelKind::Manifest);
        if fleet[1].events.iter().any(has_list) {
            fleet[1].node.expect_tiles([(key, blake3)].into());
        }
        fleet[1].disk.contains_key(&key)
    });
}
