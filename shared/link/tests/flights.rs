//! Each device announces the cameras of its flight. All other devices receive them, even those that join
//! later.
#![allow(clippy::unwrap_used)]

use std::time::Duration;

use cosurf_link::{
    Credentials, Faults, InboxLimits, MemoryNetwork, NodeEvent, Role, Trusted, select_flight_cameras,
};
use cosurf_scene::Camera;
use cosurf_tests::fleet::{Member, run_until};
use cosurf_tests::models::cameras;
use cosurf_wire::{FLIGHT_CAMERAS_MAX, FrameId};

/// The flights that a member has received.
fn heard(member: &Member) -> Vec<(String, Vec<Camera>)> {
    let flight = |event: &NodeEvent| match event {
        NodeEvent::Flight { device, cameras, .. } => Some((device.to_string(), cameras.clone())),
        _ => None,
    };
    member.events.iter().filter_map(flight).collect()
}

#[test]
fn a_late_device_receives_every_flight_but_its_own() {
    let network = MemoryNetwork::new(5, Faults { duplication: 0.2, ..Faults::NONE });
    let join = |role, name: &str| Member::new(&network, role, name, InboxLimits::default());
    let mut early = join(Role::Device, "early");
    early.node.announce_flight(&cameras(7));
    let mut elsewhere = join(Role::Device, "elsewhere");
    elsewhere
        .node
        .set_credentials(Credentials { frame: FrameId::new("utm-33n").unwrap(), ..Credentials::default() });
    elsewhere.node.announce_flight(&cameras(2));
    let mut fleet = vec![early, elsewhere, join(Role::Aggregator, "ground")];
    let is_told = |fleet: &mut [Member]| fleet.iter().all(|member| !member.events.is_empty());
    run_until(&network, &mut fleet, Duration::from_secs(5), is_told);
    let mut late = join(Role::Device, "late");
    late.node.announce_flight(&cameras(3));
    fleet.push(late);
    run_until(&network, &mut fleet, Duration::from_secs(30), |fleet| {
        !heard(&fleet[0]).is_empty() && !heard(&fleet[3]).is_empty()
    });
    let [early, elsewhere, ground, late] = &fleet[..] else { panic!("four") };
    assert!(heard(early).iter().all(|flight| *flight == ("late".to_owned(), cameras(3))), "camera by camera");
    assert!(heard(late).iter().all(|flight| *flight == ("early".to_owned(), cameras(7))));
    assert!(heard(elsewhere).is_empty(), "another frame");
    assert!(heard(ground).is_empty(), "flights are not for the aggregator");
}

#[test]
fn a_late_device_does_not_receive_a_withdrawn_flight() {
    let network = MemoryNetwork::new(7, Faults::NONE);
    let join = |role, name: &str| Member::new(&network, role, name, InboxLimits::default());
    let mut fleet =
        vec![join(Role::Device, "lost"), join(Role::Device, "sound"), join(Role::Aggregator, "ground")];
    fleet[0].node.announce_flight(&cameras(7));
    fleet[1].node.announce_flight(&cameras(5));
    run_until(&network, &mut fleet, Duration::from_secs(5), |fleet| {
        !heard(&fleet[0]).is_empty() && !heard(&fleet[1]).is_empty()
    });
    let lost = fleet.remove(0).identity.device;
    let is_kept = || network.retained("gs/v1/site/lost/flight").is_some_and(|bytes| !bytes.is_empty());
    assert!(is_kept());
    fleet[1].node.clear_flight(lost);
    run_until(&network, &mut fleet, Duration::from_secs(9), |_| !is_kept());
    fleet.push(join(Role::Device, "late"));
    run_until(&network, &mut fleet, Duration::from_secs(19), |fleet| !heard(&fleet[2]).is_empty());
    assert_eq!(heard(&fleet[2]), [("sound".to_owned(), cameras(5))]);
}

/// A device with a list of trusted keys and none of other devices ignores flights.
#[test]
fn a_device_with_trusted_keys_ignores_flights() {
    let network = MemoryNetwork::new(6, Faults::NONE);
    let mut liar = Member::new(&network, Role::Device, "liar", InboxLimits::default());
    liar.node.announce_flight(&cameras(7));
    let mut careful = Member::new(&network, Role::Device, "careful", InboxLimits::default());
    let trusted = Some(Trusted::default());
    careful.node.set_credentials(Credentials { trusted, ..Credentials::default() });
    let mut fleet = [liar, careful];
    let is_ignored = |member: &Member| {
        member
            .events
            .iter()
            .any(|event| matches!(event, NodeEvent::Ignored { topic, .. } if topic.ends_with("flight")))
    };
    run_until(&network, &mut fleet, Duration::from_secs(30), |fleet| is_ignored(&fleet[1]));
    assert!(heard(&fleet[1]).is_empty());
}

#[test]
fn a_long_flight_is_thinned_to_what_a_message_holds() {
    let told = select_flight_cameras(&cameras(3 * FLIGHT_CAMERAS_MAX));
    assert_eq!(told.len(), FLIGHT_CAMERAS_MAX);
    assert!(
        told.iter().zip(cameras(3 * FLIGHT_CAMERAS_MAX).chunks(3)).all(|(told, of)| *told == of[0]),
        "evenly thinned"
    );
    assert_eq!(select_flight_cameras(&cameras(5)), cameras(5));
    assert!(select_flight_cameras(&[]).is_empty());
}
