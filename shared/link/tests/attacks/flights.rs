//! Forged and outdated flights.

use std::time::Duration;

use cosurf_link::NodeEvent;
use cosurf_tests::fleet::Member;
use cosurf_tests::models::cameras;
use cosurf_tests::stranger::Stranger;
use cosurf_wire::{DeviceId, FlightCameras, FrameId, Message, Topic};

use crate::site::{keyed_site, network, pass, sealed_by};

const DAY_S: u64 = 24 * 3600;

fn flights(member: &Member) -> Vec<String> {
    let flight = |event: &NodeEvent| match event {
        NodeEvent::Flight(device, _) => Some(device.to_string()),
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
