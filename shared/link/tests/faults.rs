//! Faults of links, by number. Faults of other parts are tested beside the code that handles them:
//! `tests/tests/faults.rs` lists all faults.
#![allow(clippy::unwrap_used)]

use cosurf_scene::LocalFrame;
use std::time::Duration;

use cosurf_link::faults::Dice;
use cosurf_link::{
    Faults, Identity, InboxLimits, MemoryNetwork, ModelKey, Node, NodeEvent, Offer, Outgoing, Role,
    Transport, TransportEvent, body_to_model,
};
use cosurf_tests::fleet::{Member, run_until};
use cosurf_tests::offers::{identity, offer, pooled_offer};
use cosurf_wire::{
    BodyHash, DeviceId, MAX_MESSAGE_BYTES, Message, ModelId, ModelKind, RefusalReason, SiteId, State, Topic,
    VERSION,
};

const PATIENCE: Duration = Duration::from_secs(3600);

/// An aggregator, and for each offer a drone that uploads it.
fn fleet(network: &MemoryNetwork, offers: &[Offer]) -> Vec<Member> {
    let ground = Member::new(network, Role::Aggregator, "ground", InboxLimits::default());
    let drones = offers.iter().map(|offer| {
        let name = offer.header.device.to_string();
        let mut member = Member::new(network, Role::Device, &name, InboxLimits::default());
        member.node.upload(offer.clone());
        member
    });
    std::iter::once(ground).chain(drones).collect()
}

fn all_uploaded(fleet: &mut [Member]) -> bool {
    fleet[1..].iter().all(|drone| !drone.uploaded.is_empty())
}

fn assert_stored(ground: &Member, offers: &[Offer], seed: u64) {
    assert_eq!((ground.disk.len(), ground.stored_twice), (offers.len(), 0), "seed {seed}");
    for offer in offers {
        let (_, body) = &ground.disk[&ModelKey::from(offer.header)];
        assert!(*body == offer.body, "seed {seed}: other bytes");
    }
}

fn refusals(member: &Member) -> Vec<RefusalReason> {
    let reason = |event: &NodeEvent| match event {
        NodeEvent::UploadRefused { reason, .. } | NodeEvent::Refused { reason, .. } => Some(*reason),
        _ => None,
    };
    member.events.iter().filter_map(reason).collect()
}

#[test]
fn fault_01_broker_killed_in_mid_upload() {
    let offers = [offer("drone", 1, ModelKind::Local, 1, 4000, 1024)];
    for seed in 0..100 {
        let slow = Faults { bytes_per_s: std::num::NonZeroU32::new(20_000), ..Faults::NONE };
        let network = MemoryNetwork::new(seed, slow);
        let mut fleet = fleet(&network, &offers);
        let mut dice = Dice::new(seed);
        let mut kill_at = Duration::from_millis(100 + dice.below(1000));
        let (mut kills, mut is_down) = (0, false);
        run_until(&network, &mut fleet, PATIENCE, |fleet| {
            if network.now() >= kill_at && kills < 3 {
                kill_at = network.now() + Duration::from_millis(200 + dice.below(400));
                if is_down {
                    network.start()
                } else {
                    network.stop(dice.chance(0.5))
                }
                kills += u32::from(is_down);
                is_down = !is_down;
            }
            all_uploaded(fleet)
        });
        assert!(kills > 0, "seed {seed}: never killed");
        assert_stored(&fleet[0], &offers, seed);
    }
}

#[test]
fn fault_02_chunks_doubled_out_of_order_and_lost() {
    let delay_max = Duration::from_millis(500);
    let harsh = Faults { loss: 0.3, duplication: 0.3, delay_max, ..Faults::NONE };
    for seed in 0..300 {
        let network = MemoryNetwork::new(seed, harsh);
        let offers = [pooled_offer("drone", 1, ModelKind::Local, 63 - seed % 32, 1024)];
        let mut fleet = fleet(&network, &offers);
        run_until(&network, &mut fleet, PATIENCE, all_uploaded);
        assert_stored(&fleet[0], &offers, seed);
    }
}

#[test]
fn fault_03_messages_corrupt_and_truncated() {
    let foul = Faults { corruption: 0.3, truncation: 0.2, ..Faults::NONE };
    let mut noticed = 0;
    for seed in 0..300 {
        let network = MemoryNetwork::new(seed, foul);
        let offers = [pooled_offer("drone", 1, ModelKind::Local, 63 - seed % 32, 1024)];
        let mut fleet = fleet(&network, &offers);
        run_until(&network, &mut fleet, PATIENCE, all_uploaded);
        assert_stored(&fleet[0], &offers, seed);
        let is_noticed = |event: &&NodeEvent| matches!(event, NodeEvent::Ignored { .. });
        noticed += fleet[0].events.iter().filter(is_noticed).count();
    }
    assert!(noticed > 300, "hardly anything was damaged: {noticed}");
}

/// A receiver of local models, and a hostile sender that can publish to the receiver under any topic.
struct Victim {
    node: Node,
    network: MemoryNetwork,
    transport: cosurf_link::MemoryTransport,
    hostile: cosurf_link::MemoryTransport,
    /// All that the hostile sender has heard: topics and payloads.
    said: Vec<(String, Vec<u8>)>,
}

impl Victim {
    fn new(limits: InboxLimits) -> Self {
        let network = MemoryNetwork::new(1, Faults::NONE);
        let ground = identity(Role::Aggregator, "ground");
        let transport = network.join(&ground);
        let hostile = network.join_all();
        Self { node: Node::new(ground, limits, &[]), network, transport, hostile, said: Vec::new() }
    }

    fn hear(&mut self, topic: Topic, message: &Message<'_>) -> Vec<NodeEvent> {
        let payload = message.encode(&mut vec![0; MAX_MESSAGE_BYTES]).unwrap().to_vec();
        self.hear_bytes(topic, payload)
    }

    fn hear_bytes(&mut self, topic: Topic, payload: Vec<u8>) -> Vec<NodeEvent> {
        let topic = topic.to_text(&SiteId::new("site").unwrap());
        // Publishing fails if too many messages are on their way. The message is then lost, as on a real
        // network.
        let _ = self.hostile.publish(&Outgoing { topic, payload, retain: false });
        let mut events = Vec::new();
        for _ in 0..8 {
            let now = self.network.now();
            events.extend(self.node.step(&mut self.transport, || now, Duration::ZERO));
        }
        while let Some(event) = self.hostile.poll(Duration::ZERO) {
            if let TransportEvent::Incoming { topic, payload } = event {
                self.said.push((topic, payload));
            }
        }
        events
    }
}

fn header_topic(offer: &Offer) -> Topic {
    Topic::LocalHeader { device: offer.header.device, model: offer.header.model }
}

#[test]
fn fault_04_hostile_lengths() {
    let limits =
        InboxLimits { body_bytes_max: 1 << 20, total_bytes_max: 4 << 20, models_max: 16, stored_max: 16 };
    let mut victim = Victim::new(limits);
    let mut dice = Dice::new(4);
    let (mut refused, mut ignored, mut accepted) = (0, 0, 0);
    for number in 0..5000u64 {
        let mut hostile = pooled_offer("mallory", 1 + number % 64, ModelKind::Local, 1, 1024);
        let header = &mut hostile.header;
        let huge = 1u64 << dice.below(63);
        match dice.below(5) {
            0 => header.body_bytes = huge,
            1 => header.splats = huge as u32,
            2 => header.cameras = huge as u32,
            3 => header.chunk_bytes = huge as u32,
            _ => {
                header.body_bytes = dice.below(2 << 20);
                header.splats = (header.body_bytes / 16) as u32;
            }
        }
        for event in victim.hear(header_topic(&hostile), &Message::Header(hostile.header)) {
            refused += u32::from(matches!(event, NodeEvent::Refused { .. }));
            ignored += u32::from(matches!(event, NodeEvent::Ignored { .. }));
            accepted += u32::from(matches!(event, NodeEvent::Receiving(_)));
        }
        assert!(victim.node.unfinished_bytes() <= limits.total_bytes_max, "after {number}");
    }
    assert!(refused > 300 && ignored > 1000, "{refused} refused, {ignored} ignored, {accepted} accepted");
}

#[test]
fn fault_06_values_that_cannot_be_rendered() {
    let mut stored = 0;
    for seed in 0..400 {
        let network = MemoryNetwork::new(seed, Faults::NONE);
        let mut bad = offer("drone", 1, ModelKind::Local, seed, 200, 1024);
        let mut dice = Dice::new(seed);
        for _ in 0..1 + dice.below(20) {
            let place = dice.below(bad.body.len() as u64) as usize;
            bad.body[place] = [0, 0x7F, 0x80, 0xFF, dice.next_bits() as u8][dice.below(5) as usize];
        }
        // The header announces the hash of the changed bytes, so that only the values can be refused.
        bad.header.blake3 = BodyHash(*blake3::hash(&bad.body).as_bytes());
        let mut fleet = fleet(&network, std::slice::from_ref(&bad));
        run_until(&network, &mut fleet, PATIENCE, |fleet| {
            !fleet[1].uploaded.is_empty() || !refusals(&fleet[1]).is_empty()
        });
        match fleet[0].disk.values().next() {
            None => assert_eq!(refusals(&fleet[1]), [RefusalReason::BadBody], "seed {seed}"),
            Some((header, body)) => {
                stored += 1;
                let splats = body_to_model(body, &LocalFrame::WORLD).unwrap().splats;
                assert!(splats.means.iter().all(|mean| header.bounds.contains(*mean)), "seed {seed}");
                let values = splats.log_scales.iter().flatten().chain(splats.quats.iter().flatten());
                assert!(
                    values.chain(&splats.opacity_logits).chain(&splats.sh).all(|value| value.is_finite())
                );
                let longest = |quat: &[f32; 4]| quat.iter().fold(0.0f32, |most, value| most.max(value.abs()));
                assert!(splats.quats.iter().all(|quat| longest(quat) > 0.0), "seed {seed}: no rotation");
            }
        }
    }
    assert!(stored < 390, "nothing was ever refused");
}

#[test]
fn fault_08_replays_old_counters_and_wrong_names() {
    let network = MemoryNetwork::new(8, Faults::NONE);
    let honest = offer("drone", 1, ModelKind::Local, 1, 300, 1024);
    let mut fleet = fleet(&network, std::slice::from_ref(&honest));
    run_until(&network, &mut fleet, PATIENCE, all_uploaded);
    let mut victim = Victim::new(InboxLimits::default());
    victim.node = Node::new(identity(Role::Aggregator, "ground"), InboxLimits::default(), &[honest.header]);
    // The node connects during this first call.
    victim.hear_bytes(header_topic(&honest), Vec::new());
    let replayed = victim.hear(header_topic(&honest), &Message::Header(honest.header));
    assert!(matches!(replayed[..], [NodeEvent::Known(_)]), "a replay is known already: {replayed:?}");
    let other = offer("drone", 1, ModelKind::Local, 2, 300, 1024);
    let events = victim.hear(header_topic(&other), &Message::Header(other.header));
    assert!(
        matches!(events[..], [NodeEvent::Refused { reason: RefusalReason::NumberTaken, .. }]),
        "an old number for another body: {events:?}"
    );
    let device = DeviceId::new("mallory").unwrap();
    for topic in [
        Topic::LocalHeader { device, model: ModelId(1) },
        Topic::LocalHeader { device: honest.header.device, model: ModelId(2) },
    ] {
        let events = victim.hear(topic, &Message::Header(honest.header));
        assert!(
            matches!(&events[..], [NodeEvent::Ignored { reason, .. }] if reason.contains("match its topic")),
            "under {topic}: {events:?}"
        );
    }
    assert_eq!(victim.node.unfinished_bytes(), 0);
}

#[test]
fn fault_12_clocks_that_jump() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("session");
    let year_s: u64 = 365 * 24 * 3600;
    let mut dice = Dice::new(12);
    let (mut clock_s, mut last) = (56 * year_s, 0);
    for _ in 0..200 {
        clock_s = match dice.below(4) {
            0 => clock_s + year_s,
            1 => clock_s.saturating_sub(year_s),
            2 => 0,
            _ => clock_s + dice.below(100),
        };
        let session = cosurf_link::next_session(&path, clock_s).unwrap();
        assert!(session > last, "{session} after {last}");
        last = session;
    }
    // The broker publishes the last will of the previous session after the birth of the next session.
    let mut victim = Victim::new(InboxLimits::default());
    let device = DeviceId::new("drone").unwrap();
    let mut say = |session, alive| {
        victim.hear(Topic::State { device }, &Message::State(State { device, session, alive }))
    };
    say(6, true);
    let is_state = |event: &NodeEvent| matches!(event, NodeEvent::State(_));
    assert!(say(7, true).iter().any(is_state));
    assert!(
        !say(6, false).iter().any(is_state),
        "the will of an earlier session is taken for the present one"
    );
    assert!(say(7, false).iter().any(is_state));
}

#[test]
fn fault_13_a_stalled_upload_does_not_slow_the_others() {
    let time = |stalls: bool| {
        let network = MemoryNetwork::new(13, Faults::NONE);
        let offers: Vec<Offer> =
            (0..20).map(|i| offer(&format!("drone-{i}"), 1, ModelKind::Local, i, 2000, 1024)).collect();
        let mut fleet = fleet(&network, &offers);
        let mut stalls = stalls;
        run_until(&network, &mut fleet, PATIENCE, |fleet| {
            if stalls && fleet[0].node.unfinished_bytes() > 0 {
                // The aggregator has accepted an upload of this drone. From now on the drone sends nothing.
                fleet[1].node = Node::new(fleet[1].identity, InboxLimits::default(), &[]);
                stalls = false;
            }
            fleet[2..].iter().all(|drone| !drone.uploaded.is_empty())
        });
        network.now()
    };
    let (alone, beside) = (time(false), time(true));
    assert!(beside <= alone + Duration::from_millis(100), "{beside:?} instead of {alone:?}");
}

#[test]
fn fault_14_messages_larger_than_the_broker_takes() {
    for limit in [1500, 3000, 5000, 20_000, 70_000] {
        let network = MemoryNetwork::new(14, Faults::NONE);
        network.limit_packets(limit);
        let offers = [offer("drone", 1, ModelKind::Local, 1, 20_000, 65_536)];
        let mut fleet = fleet(&network, &offers);
        run_until(&network, &mut fleet, PATIENCE, all_uploaded);
        assert!(fleet[0].disk.values().all(|(_, body)| *body == offers[0].body), "{limit}");
    }
    let network = MemoryNetwork::new(14, Faults::NONE);
    network.limit_packets(300);
    let mut fleet = fleet(&network, &[offer("drone", 1, ModelKind::Local, 1, 20_000, 65_536)]);
    run_until(&network, &mut fleet, PATIENCE, |fleet| {
        fleet[1].events.iter().any(|event| matches!(event, NodeEvent::LinkTooNarrow(_)))
    });
}

#[test]
fn fault_15_two_drones_under_one_name() {
    for seed in 0..200 {
        let faults = Faults { loss: 0.1, delay_max: Duration::from_millis(300), ..Faults::NONE };
        let network = MemoryNetwork::new(seed, faults);
        let offers = [1, 2].map(|body| pooled_offer("drone", 1, ModelKind::Local, 2 * seed + body, 1024));
        let mut fleet = fleet(&network, &offers);
        run_until(&network, &mut fleet, PATIENCE, |fleet| {
            // Each drone gets a final answer. Its model is stored, or refused because the number is taken or
            // because the chunks of both bodies were mixed.
            let is_told = |drone: &Member| {
                let is_final = |reason: &RefusalReason| !reason.is_temporary();
                !drone.uploaded.is_empty() || refusals(drone).iter().any(is_final)
            };
            fleet[1..].iter().all(is_told)
        });
        let ground = &fleet[0];
        assert!(ground.disk.len() <= 1 && ground.stored_twice == 0, "seed {seed}");
        let is_offered = |body: &Vec<u8>| offers.iter().any(|offer| offer.body == *body);
        assert!(ground.disk.values().all(|(_, body)| is_offered(body)), "seed {seed}: a mixture was stored");
    }
}

#[test]
fn fault_18_link_down_for_ten_minutes_then_the_upload_continues() {
    let offers = [offer("drone", 1, ModelKind::Local, 1, 10_000, 1024)];
    for seed in 0..20 {
        let slow = Faults { bytes_per_s: std::num::NonZeroU32::new(10_000), ..Faults::NONE };
        let network = MemoryNetwork::new(seed, slow);
        let mut fleet = fleet(&network, &offers);
        let cut_at = Duration::from_millis(6000 + seed * 100);
        let mended_at = cut_at + Duration::from_secs(600);
        let (mut is_cut, mut is_mended) = (false, false);
        run_until(&network, &mut fleet, PATIENCE, |fleet| {
            if !is_cut && network.now() >= cut_at {
                is_cut = true;
                network.stop(true);
            }
            if !is_mended && network.now() >= mended_at {
                is_mended = true;
                network.start();
            }
            all_uploaded(fleet)
        });
        assert!(is_mended, "seed {seed}: the upload ended before the link came back");
        assert_stored(&fleet[0], &offers, seed);
        let sent = fleet[1].events.iter().filter_map(|event| match event {
            NodeEvent::Progress(_, progress) | NodeEvent::Uploaded(_, progress) => Some(progress.bytes_sent),
            _ => None,
        });
        let (sent, body) = (sent.max().unwrap(), offers[0].body.len() as u64);
        // Chunks in flight are sent again after the outage: at most one window of 32 chunks of 1024 bytes.
        assert!(sent < body * 11 / 10 + 32 * 1024, "seed {seed}: {sent} for {body}");
    }
}

#[test]
fn fault_19_other_version() {
    for version in [VERSION - 1, VERSION + 1] {
        let mut victim = Victim::new(InboxLimits::default());
        let offer = offer("mallory", 1, ModelKind::Local, 1, 10, 1024);
        let mut payload = vec![0; MAX_MESSAGE_BYTES];
        let length = Message::Header(offer.header).encode(&mut payload).unwrap().len();
        payload.truncate(length);
        payload[0] = version;
        let (content, checksum) = payload.split_last_chunk_mut::<4>().unwrap();
        *checksum = crc32(content).to_le_bytes();
        victim.hear_bytes(header_topic(&offer), Vec::new());
        let events = victim.hear_bytes(header_topic(&offer), payload);
        let is_told = |event: &NodeEvent| matches!(event, NodeEvent::OtherVersion { version: other, .. } if *other == version);
        assert!(events.iter().any(is_told), "version {version}: {events:?}");
        // A device of the version before is refused in its own language.
        let refusals =
            victim.said.iter().filter(|(topic, payload)| topic.ends_with("/dn/refused") && payload[0] == 2);
        assert_eq!(refusals.count(), usize::from(version < VERSION));
    }
}

/// If two clients share a name, the broker disconnects the first when the second connects. The first
/// reconnects, and the broker disconnects the second.
#[test]
fn two_drones_under_one_name_are_told_apart_from_a_restart() {
    let mut victim = Victim::new(InboxLimits::default());
    let device = DeviceId::new("drone").unwrap();
    let mut births = |sessions: &[u64]| {
        let say = |session| Message::State(State { device, session, alive: true });
        let events = sessions.iter().flat_map(|s| victim.hear(Topic::State { device }, &say(*s)));
        events.collect::<Vec<_>>().iter().filter(|event| matches!(event, NodeEvent::SameName(_))).count()
    };
    assert_eq!(births(&[1, 5, 5, 9, 5, 12, 9]), 0, "restarts, and retained states of the past");
    assert_eq!(births(&[7, 12, 7, 12, 7, 12]), 1, "reported once");
}

/// A built-in broker lets its own aggregator stay connected when another one connects under the same name.
#[test]
fn a_later_session_under_the_own_name_is_told_once() {
    let mut victim = Victim::new(InboxLimits::default());
    let Identity { device, session: own, .. } = identity(Role::Aggregator, "ground");
    let mut birth = |session, alive| {
        let state = Message::State(State { device, session, alive });
        let events = victim.hear(Topic::State { device }, &state);
        events.iter().filter(|event| matches!(event, NodeEvent::SameName(_))).count()
    };
    assert_eq!(birth(own - 1, true) + birth(own, true) + birth(own + 5, false), 0, "its own, and an end");
    assert_eq!(birth(own + 5, true) + birth(own + 5, true), 1);
    assert_eq!(birth(own + 9, true), 1);
}

/// Computes a CRC-32 bit by bit, independently of the crate under test.
fn crc32(bytes: &[u8]) -> u32 {
    let step = |crc: u32, _| if crc & 1 == 1 { crc >> 1 ^ 0xEDB8_8320 } else { crc >> 1 };
    !bytes.iter().fold(!0, |crc: u32, byte| (0..8).fold(crc ^ u32::from(*byte), step))
}

#[test]
fn fault_20_memory_stays_bounded_under_noise() {
    let limits =
        InboxLimits { body_bytes_max: 1 << 16, total_bytes_max: 1 << 18, models_max: 8, stored_max: 8 };
    let mut victim = Victim::new(limits);
    let mut dice = Dice::new(20);
    let site = SiteId::new("site").unwrap();
    for round in 0..4_000u64 {
        let valid =
            offer(&format!("d{}", dice.below(100)), dice.below(50), ModelKind::Local, round, 20, 1024);
        let mut payload = vec![0; MAX_MESSAGE_BYTES];
        let length = Message::Header(valid.header).encode(&mut payload).unwrap().len();
        payload.truncate(length);
        if dice.chance(0.5) {
            let place = dice.below(length as u64) as usize;
            payload[place] ^= 1 << dice.below(8);
            let (content, checksum) = payload.split_last_chunk_mut::<4>().unwrap();
            *checksum = crc32(content).to_le_bytes();
        }
        victim.hear_bytes(header_topic(&valid), payload);
        assert!(victim.node.unfinished_bytes() <= limits.total_bytes_max, "round {round}");
        let now = victim.network.now();
        victim.network.advance(now + Duration::from_millis(dice.below(20_000)));
    }
    // After the noise, another participant can still connect.
    let listener = Identity { site, ..identity(Role::Device, "listener") };
    let mut transport = victim.network.join(&listener);
    assert_eq!(transport.poll(Duration::ZERO), Some(TransportEvent::Connected));
}
