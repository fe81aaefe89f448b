//! Reservations of memory.

use std::time::{Duration, Instant};

use cosurf_link::{InboxLimits, NodeEvent};
use cosurf_tests::dice::Dice;
use cosurf_tests::fleet::{Member, run_until};
use cosurf_tests::offers::offer;
use cosurf_tests::stranger::Stranger;
use cosurf_wire::message::Chunk;
use cosurf_wire::{DeviceId, Message, Missing, ModelHeader, ModelId, ModelKind, Topic};

use crate::site::{network, open_site, pass};

const LIMITS: InboxLimits =
    InboxLimits { body_bytes_max: 64 << 20, total_bytes_max: 64 << 20, models_max: 64, stored_max: 64 };

/// A header that reserves 60 MB.
fn large(device: &str, model: u64) -> ModelHeader {
    let device = DeviceId::new(device).unwrap();
    let small = offer("mallory", model, ModelKind::Local, 1, 50, 4096).header;
    let header =
        ModelHeader { device, splats: 1_000_000, body_bytes: 20_000_000, chunk_bytes: 65_536, ..small };
    header.check().unwrap();
    header
}

fn announce(stranger: &mut Stranger, header: ModelHeader) {
    let topic = Topic::LocalHeader { device: header.device, model: header.model };
    stranger.say(topic, &Message::Header(header));
}

fn is_busy(member: &Member) -> bool {
    member.events.iter().any(|event| matches!(event, NodeEvent::UploadRefused { .. }))
}

/// Headers alone take no memory to speak of, so honest uploads are not delayed.
#[test]
fn attack_06_headers_reserve_no_more_than_they_send() {
    let network = network();
    let mut fleet = open_site(&network, LIMITS, &["drone-1", "drone-2"]);
    let mut stranger = Stranger::new(&network);
    for i in 0..20 {
        announce(&mut stranger, large(&format!("mallory-{i}"), 1));
    }
    pass(&network, &mut fleet, &mut stranger, Duration::from_millis(100));
    assert_eq!(fleet[0].node.unfinished().count(), 20);
    assert!(fleet[0].node.unfinished_bytes() <= 20 << 20, "{}", fleet[0].node.unfinished_bytes());
    for (i, name) in ["drone-1", "drone-2"].into_iter().enumerate() {
        fleet[1 + i].node.upload(offer(name, 1, ModelKind::Local, 3, 100_000, 65_536));
    }
    run_until(&network, &mut fleet, Duration::from_secs(10), |fleet| {
        stranger.listen();
        fleet[1..].iter().all(|drone| !drone.uploaded.is_empty())
    });
    assert!(!fleet[1..].iter().any(is_busy));
}

/// All places are taken by headers and a few junk chunks. They are given up soon.
#[test]
fn attack_06_reservations_without_progress_are_given_up() {
    let network = network();
    let limits = InboxLimits { models_max: 8, ..LIMITS };
    let mut fleet = open_site(&network, limits, &["drone-1"]);
    let mut stranger = Stranger::new(&network);
    for i in 0..8 {
        let header = large(&format!("mallory-{i}"), 1);
        announce(&mut stranger, header);
        let (device, model) = (header.device, header.model);
        let junk = Chunk { device, model, index: 0, payload: &[7; 65_536] };
        stranger.say(Topic::LocalChunk { device, model, index: 0 }, &Message::Chunk(junk));
    }
    pass(&network, &mut fleet, &mut stranger, Duration::from_millis(100));
    assert_eq!(fleet[0].node.unfinished().count(), 8);
    fleet[1].node.upload(offer("drone-1", 1, ModelKind::Local, 3, 20_000, 65_536));
    run_until(&network, &mut fleet, Duration::from_secs(100), |fleet| {
        stranger.listen();
        !fleet[1].uploaded.is_empty()
    });
    assert!(is_busy(&fleet[1]), "there were places left, so the test shows nothing");
}

/// One device takes no more than its share, however many models it announces.
#[test]
fn attack_06_one_device_does_not_take_all_the_room() {
    let network = network();
    let mut fleet = open_site(&network, LIMITS, &["drone-1"]);
    let mut stranger = Stranger::new(&network);
    let mut dice = Dice(6);
    let mut next = 1;
    fleet[1].node.upload(offer("drone-1", 1, ModelKind::Local, 3, 100_000, 65_536));
    run_until(&network, &mut fleet, Duration::from_secs(10), |fleet| {
        for _ in 0..4 {
            let header = large("mallory", next);
            next += 1;
            announce(&mut stranger, header);
            let (device, model, index) =
                (header.device, ModelId(1 + dice.bits() % next), dice.bits() as u32 % 64);
            let junk = Chunk { device, model, index, payload: &[7; 65_536] };
            stranger.say(Topic::LocalChunk { device, model, index }, &Message::Chunk(junk));
        }
        stranger.listen();
        let held = fleet[0].node.unfinished().filter(|header| header.device.as_str() == "mallory").count();
        assert!(held <= 4, "{held} of one device");
        !fleet[1].uploaded.is_empty()
    });
    assert!(!is_busy(&fleet[1]));
}

/// Four devices that fill the memory, each with several models that get on, do not keep a fifth out.
#[test]
fn attack_06_hoarders_give_way_to_a_device_with_one_model() {
    let network = network();
    let mut fleet = open_site(&network, LIMITS, &["drone-1"]);
    let mut stranger = Stranger::new(&network);
    let places = (0..4).flat_map(|hoarder| (1..=4).map(move |model| (hoarder, model)));
    let headers: Vec<ModelHeader> = places
        .map(|(hoarder, model)| {
            let sizes = ModelHeader { splats: 200_000, body_bytes: 4_150_000, ..large("mallory", model) };
            ModelHeader { device: DeviceId::new(&format!("mallory-{hoarder}")).unwrap(), ..sizes }
        })
        .collect();
    let mut index = 0;
    let mut hoard = |fleet: &mut [Member], stranger: &mut Stranger| {
        for header in &headers {
            announce(stranger, *header);
            let (device, model) = (header.device, header.model);
            let junk = Chunk { device, model, index, payload: &[7; 65_536] };
            stranger.say(Topic::LocalChunk { device, model, index }, &Message::Chunk(junk));
            // Few messages may be on their way at once.
            fleet.iter_mut().for_each(|member| member.work(&network));
            stranger.listen();
        }
        index = (index + 1) % 60;
    };
    for _ in 0..40 {
        hoard(&mut fleet, &mut stranger);
        network.advance(network.now() + Duration::from_millis(20));
    }
    let full = fleet[0].node.unfinished_bytes();
    assert!(full > (64 << 20) - 1_000_000, "{full} bytes are taken, so the test shows nothing");
    let begun = network.now();
    fleet[1].node.upload(offer("drone-1", 1, ModelKind::Local, 3, 200_000, 65_536));
    run_until(&network, &mut fleet, begun + Duration::from_secs(10), |fleet| {
        hoard(fleet, &mut stranger);
        assert!(fleet[0].node.unfinished_bytes() <= LIMITS.total_bytes_max);
        !fleet[1].uploaded.is_empty()
    });
    assert!(!is_busy(&fleet[1]));
}

/// Uploads that do not fit together end one after the other.
#[test]
fn attack_06_uploads_that_wait_for_room_end() {
    let network = network();
    let limits =
        InboxLimits { body_bytes_max: 6 << 20, total_bytes_max: 6 << 20, models_max: 64, stored_max: 64 };
    let names = ["drone-1", "drone-2", "drone-3", "drone-4", "drone-5", "drone-6", "drone-7"];
    let mut fleet = open_site(&network, limits, &names);
    for (i, name) in names.into_iter().enumerate() {
        let offer = offer(name, 1, ModelKind::Local, i as u64, 90_000, 16_384);
        assert!(7 * offer.header.body_bytes > limits.total_bytes_max, "{}", offer.header.body_bytes);
        fleet[1 + i].node.upload(offer);
    }
    run_until(&network, &mut fleet, Duration::from_secs(600), |fleet| {
        assert!(fleet[0].node.unfinished_bytes() <= limits.total_bytes_max);
        fleet[1..].iter().all(|drone| !drone.uploaded.is_empty())
    });
}

/// The work for a request is bounded: chunks are not too small, and not too many.
#[test]
fn attack_06_tiny_chunks_are_refused_and_a_want_is_cheap() {
    let header = large("mallory", 1);
    for chunk_bytes in [1, 100, 255] {
        assert!(ModelHeader { chunk_bytes, ..header }.check().is_err(), "{chunk_bytes}");
    }
    let many = ModelHeader { splats: 20_000_000, body_bytes: 400_000_000, chunk_bytes: 1024, ..header };
    assert!(many.check().is_err(), "{} chunks", many.chunks());
    let begun = Instant::now();
    (0..100).for_each(|_| _ = std::hint::black_box(Missing::of(cosurf_wire::MAX_CHUNKS, |i| i % 2 == 0)));
    assert!(begun.elapsed() < Duration::from_secs(1), "{:?} for 100", begun.elapsed());
}

/// A device sends nearly all of the largest model that is allowed, and then a chunk now and then. There is room for others.
#[test]
fn attack_06_one_huge_model_leaves_room_for_others() {
    let network = network();
    let limits = InboxLimits { body_bytes_max: 48 << 20, ..LIMITS };
    let mut fleet = open_site(&network, limits, &["drone-1"]);
    let mut stranger = Stranger::new(&network);
    let huge = ModelHeader { splats: 480_000, body_bytes: 48 << 20, ..large("mallory", 1) };
    huge.check().unwrap();
    announce(&mut stranger, huge);
    let (device, model) = (huge.device, huge.model);
    let send = |fleet: &mut [Member], stranger: &mut Stranger, index: u32| {
        let junk = Chunk { device, model, index, payload: &[7; 65_536] };
        stranger.say(Topic::LocalChunk { device, model, index }, &Message::Chunk(junk));
        fleet.iter_mut().for_each(|member| member.work(&network));
        stranger.listen();
        network.advance(network.now() + Duration::from_millis(20));
    };
    for index in 0..huge.chunks() - 40 {
        send(&mut fleet, &mut stranger, index);
    }
    let taken = fleet[0].node.unfinished_bytes();
    assert!(taken > 40 << 20, "{taken} bytes are taken, so the test shows nothing");
    let begun = network.now();
    fleet[1].node.upload(offer("drone-1", 1, ModelKind::Local, 3, 200_000, 65_536));
    let mut late = huge.chunks() - 40..huge.chunks() - 1;
    run_until(&network, &mut fleet, begun + Duration::from_secs(10), |fleet| {
        if let Some(index) = late.next() {
            send(fleet, &mut stranger, index);
        }
        !fleet[1].uploaded.is_empty()
    });
    assert!(!is_busy(&fleet[1]));
}
