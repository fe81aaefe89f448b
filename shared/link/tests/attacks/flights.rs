//! Forged and outdated flights.

use std::time::Duration;

use cosurf_link::{Credentials, MemoryNetwork, NodeEvent, flight_hash};
use cosurf_tests::fleet::Member;
use cosurf_tests::models::cameras;
use cosurf_tests::stranger::Stranger;
use cosurf_wire::{BodyHash, DeviceId, FlightCameras, FrameId, Message, Topic};

use crate::site::{drone_credentials, ground_credentials, keyed_site, network, pass, sealed_by};

const DAY_S: u64 = 24 * 3600;

fn flights(member: &Member) -> Vec<String> {
    let flight = |event: &NodeEvent| match event {
        NodeEvent::Flight { device, .. } => Some(device.to_string()),
        _ => None,
    };
    member.events.iter().filter_map(flight).collect()
}

/// A ghost's flight would make every drone withhold the ground that it claims.
#[test]
fn attack_11_ghosts_and_old_flights_do_not_count() {
    let network = network();
    let mut fleet = keyed_site(&network);
    let mut stranger = Stranger::new(&network);
    fleet[1].identity.session = 100 * DAY_S;
    fleet[1].restart(&network);
    fleet[1].node.set_credentials(crate::site::drone_credentials("drone-1"));
    let bytes = vec![0; 0];
    let say = |name: &str, by: Option<(&str, u64)>, stranger: &mut Stranger| {
        let device = DeviceId::new(name).unwrap();
        let message = Message::Flight(FlightCameras { device, frame: FrameId::default(), cameras: &bytes });
        let topic = Topic::Flight { device };
        match by {
            None => stranger.say(topic, &message),
            Some((by, session)) => {
                let (topic, payload) = sealed_by(by, session, 1, topic, &message);
                stranger.say_bytes(&topic, payload);
            }
        }
    };
    say("ghost-1", None, &mut stranger);
    say("drone-2", None, &mut stranger);
    say("ghost-2", Some(("ghost-2", 100 * DAY_S)), &mut stranger);
    say("drone-2", Some(("ground", 100 * DAY_S)), &mut stranger);
    say("ghost-3", Some(("drone-2", 100 * DAY_S)), &mut stranger);
    say("drone-2", Some(("drone-2", 98 * DAY_S)), &mut stranger); // recorded two days ago
    pass(&network, &mut fleet, &mut stranger, Duration::from_secs(1));
    assert_eq!(flights(&fleet[1]), [""; 0]);
    assert_eq!(fleet[1].node.forged(), 5, "the old flight is genuine, but outdated");
    // A genuine flight counts, and an older one of the same drone does not replace it.
    say("drone-2", Some(("drone-2", 100 * DAY_S)), &mut stranger);
    say("drone-2", Some(("drone-2", 100 * DAY_S - 1)), &mut stranger);
    pass(&network, &mut fleet, &mut stranger, Duration::from_secs(1));
    assert_eq!(flights(&fleet[1]), ["drone-2"]);
    // So does one that the drone itself announces.
    fleet[2].identity.session = 101 * DAY_S;
    fleet[2].restart(&network);
    fleet[2].node.set_credentials(crate::site::drone_credentials("drone-2"));
    fleet[2].node.announce_flight(&cameras(3));
    pass(&network, &mut fleet, &mut stranger, Duration::from_secs(1));
    assert_eq!(flights(&fleet[1]), ["drone-2", "drone-2"]);
}

/// The flights of the newest list that a device has got.
fn confirmed(member: &Member) -> Vec<(String, BodyHash)> {
    let list = |event: &NodeEvent| match event {
        NodeEvent::ConfirmedFlights(list) => {
            Some(list.iter().map(|(device, hash)| (device.to_string(), *hash)).collect())
        }
        _ => None,
    };
    member.events.iter().rev().find_map(list).unwrap_or_default()
}

/// The pledges that the aggregator has got since the last call.
fn pledges(ground: &mut Member) -> Vec<(DeviceId, BodyHash)> {
    let pledge = |event: NodeEvent| match event {
        NodeEvent::FlightPledged { device, cameras_blake3, .. } => Some((device, cameras_blake3)),
        _ => None,
    };
    ground.events.drain(..).filter_map(pledge).collect()
}

fn restart(member: &mut Member, network: &MemoryNetwork, credentials: Credentials) {
    member.events.clear();
    member.restart(network);
    member.node.set_credentials(credentials);
}

/// A drone announces its flight only once it knows its cell of the plan, after the aggregator's first list.
#[test]
fn a_flight_that_is_announced_late_is_pledged_too() {
    let network = network();
    let mut fleet = keyed_site(&network);
    let mut stranger = Stranger::new(&network);
    pass(&network, &mut fleet, &mut stranger, Duration::from_secs(5));
    fleet[1].node.announce_flight(&cameras(3));
    pass(&network, &mut fleet, &mut stranger, Duration::from_secs(3));
    let drone_1 = DeviceId::new("drone-1").unwrap();
    assert_eq!(pledges(&mut fleet[0]).first(), Some(&(drone_1, flight_hash(&cameras(3)))));
}

/// A flight with a right signature, which somebody has recorded in an earlier mission, counts no longer: the aggregator does
/// not confirm it, and its earlier word does not count for the devices of the present mission.
#[test]
fn attack_11_a_recorded_flight_is_not_confirmed() {
    let network = network();
    let mut fleet = keyed_site(&network);
    let mut stranger = Stranger::new(&network);
    let drone_1 = DeviceId::new("drone-1").unwrap();
    let hash = flight_hash(&cameras(3));
    fleet[1].node.announce_flight(&cameras(3));
    fleet[2].node.announce_flight(&cameras(2));
    pass(&network, &mut fleet, &mut stranger, Duration::from_secs(1));
    let pledged = pledges(&mut fleet[0]);
    assert!(pledged.len() == 2 && pledged[0] == (drone_1, hash), "{pledged:?}");
    fleet[0].node.confirm_flights(pledged);
    pass(&network, &mut fleet, &mut stranger, Duration::from_secs(3));
    let names = confirmed(&fleet[2]).into_iter().map(|(name, _)| name).collect::<Vec<_>>();
    assert_eq!(names, ["drone-1", "drone-2"]);
    assert_eq!(pledges(&mut fleet[0]), [], "no pledge is repeated once it is listed");

    // The next mission, without drone-1.
    network.leave(fleet.remove(1).transport);
    restart(&mut fleet[0], &network, ground_credentials());
    restart(&mut fleet[1], &network, drone_credentials("drone-2"));
    fleet[1].node.announce_flight(&cameras(2));
    let recorded = std::mem::take(&mut stranger.heard);
    for _ in 0..3 {
        for (topic, payload) in &recorded {
            stranger.say_bytes(topic, payload.clone());
        }
        pass(&network, &mut fleet, &mut stranger, Duration::from_secs(3));
        let pledged = pledges(&mut fleet[0]);
        assert!(pledged.iter().all(|(device, _)| *device != drone_1), "{pledged:?}");
        fleet[0].node.confirm_flights(vec![(DeviceId::new("drone-2").unwrap(), flight_hash(&cameras(2)))]);
    }
    pass(&network, &mut fleet, &mut stranger, Duration::from_secs(3));
    assert!(flights(&fleet[1]).contains(&"drone-1".to_owned()), "the flight itself is genuine");
    assert_eq!(confirmed(&fleet[1]), [("drone-2".to_owned(), flight_hash(&cameras(2)))]);
}

/// Whoever signs a pledge for any session that is asked of it makes recordings for later missions.
#[test]
fn attack_11_a_stranger_cannot_have_a_flight_pledged() {
    let network = network();
    let mut fleet = keyed_site(&network);
    let mut stranger = Stranger::new(&network);
    fleet[1].node.announce_flight(&cameras(3));
    let keyless = Credentials { trusted: None, ..drone_credentials("drone-2") };
    fleet[2].node.set_credentials(keyless);
    fleet[2].node.announce_flight(&cameras(2));
    network.leave(fleet.remove(0).transport);
    pass(&network, &mut fleet, &mut stranger, Duration::from_secs(1));
    for member in &fleet {
        let (device, session) = (member.identity.device, member.identity.session);
        let list = cosurf_wire::ConfirmedFlights { device, session, first: 0, total: 0, flights: &[] };
        let topic = Topic::LocalReply { device, reply: cosurf_wire::Reply::Flight };
        stranger.say(topic, &Message::ConfirmedFlights(list));
        for by in ["eve", "drone-1"] {
            let (topic, payload) = sealed_by(by, 1 << 39, 1, topic, &Message::ConfirmedFlights(list));
            stranger.say_bytes(&topic, payload);
        }
    }
    pass(&network, &mut fleet, &mut stranger, Duration::from_secs(5));
    assert_eq!(stranger.heard_on("/global/flight"), []);
}
