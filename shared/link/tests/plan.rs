//! A device that asks for its cell of the site's plan gets it from the aggregator, or the word that it has none.
#![allow(clippy::unwrap_used)]

use std::collections::BTreeMap;
use std::time::Duration;

use cosurf_link::{Credentials, Faults, InboxLimits, MemoryNetwork, NodeEvent, PlannedCell, Role};
use cosurf_tests::fleet::{Member, run_until};
use cosurf_tests::stranger::Stranger;
use cosurf_wire::{DeviceId, FrameId, VerticalAxis};

fn cell() -> PlannedCell {
    let corners = vec![[0.0, 0.0], [90.5, 0.0], [90.5, 70.0], [0.0, 70.0]];
    PlannedCell { vertical: VerticalAxis::Z, corners, margin: 0.2 }
}

/// The aggregator of a site whose plan has a cell for drone-1 only.
fn ground(network: &MemoryNetwork) -> Member {
    let mut ground = Member::new(network, Role::Aggregator, "ground", InboxLimits::default());
    let frame = FrameId::new("enu").unwrap();
    ground.node.set_credentials(Credentials { frame, ..Credentials::default() });
    ground.node.share_plan(BTreeMap::from([(DeviceId::new("drone-1").unwrap(), cell())]));
    ground
}

fn drone(network: &MemoryNetwork, name: &str) -> Member {
    let mut drone = Member::new(network, Role::Device, name, InboxLimits::default());
    drone.node.ask_for_plan();
    drone
}

/// The answers that a member has got.
fn answers(member: &Member) -> Vec<(String, Option<PlannedCell>)> {
    let answer = |event: &NodeEvent| match event {
        NodeEvent::Plan { frame, cell } => Some((frame.to_string(), cell.clone())),
        _ => None,
    };
    member.events.iter().filter_map(answer).collect()
}

#[test]
fn a_device_gets_its_cell_and_one_without_a_cell_is_told_so() {
    let network = MemoryNetwork::new(3, Faults::NONE);
    let quiet = Member::new(&network, Role::Device, "quiet", InboxLimits::default());
    let mut fleet = vec![ground(&network), drone(&network, "drone-1"), drone(&network, "drone-2"), quiet];
    let are_told = |fleet: &mut [Member]| fleet[1..3].iter().all(|member| !answers(member).is_empty());
    run_until(&network, &mut fleet, Duration::from_secs(1), are_told);
    run_until(&network, &mut fleet, Duration::from_secs(9), |_| network.now() > Duration::from_secs(8));
    assert_eq!(answers(&fleet[1]), [("enu".to_owned(), Some(cell()))], "once");
    assert_eq!(answers(&fleet[2]), [("enu".to_owned(), None)]);
    assert_eq!(answers(&fleet[3]), [], "it has not asked");
    // A late aggregator answers what the broker has kept.
    network.leave(fleet.remove(0).transport);
    fleet[1].restart(&network);
    fleet[1].node.ask_for_plan();
    run_until(&network, &mut fleet, Duration::from_secs(40), |_| network.now() > Duration::from_secs(30));
    fleet.push(ground(&network));
    fleet[1].events.clear();
    run_until(&network, &mut fleet, Duration::from_secs(32), |fleet| !answers(&fleet[1]).is_empty());
}

/// With half of all messages lost, the questions and answers that get through are enough.
#[test]
fn a_lost_answer_is_sent_again() {
    let told: usize = (0..40)
        .map(|seed| {
            let network = MemoryNetwork::new(seed, Faults { loss: 0.3, ..Faults::NONE });
            let mut fleet = [ground(&network), drone(&network, "drone-1")];
            let end = Duration::from_secs(5);
            run_until(&network, &mut fleet, end, |_| network.now() > Duration::from_secs(4));
            answers(&fleet[1]).len().min(1)
        })
        .sum();
    assert!(told >= 38, "{told} of 40");
}

/// Lets time pass.
fn pass(network: &MemoryNetwork, members: &mut [Member], stranger: &mut Stranger, seconds: u64) {
    let end = network.now() + Duration::from_secs(seconds);
    while network.now() < end {
        members.iter_mut().for_each(|member| member.work(network));
        stranger.listen();
        network.advance(end.min(network.now() + Duration::from_millis(20)));
    }
}

/// Nobody signs here, so the number of the session alone tells a recorded plan from one for this session.
#[test]
fn a_recorded_plan_does_not_count_in_a_later_session() {
    let network = MemoryNetwork::new(4, Faults::NONE);
    let mut stranger = Stranger::new(&network);
    let mut fleet = vec![ground(&network), drone(&network, "drone-1")];
    pass(&network, &mut fleet, &mut stranger, 1);
    assert_eq!(answers(&fleet[1]).len(), 1);
    let recorded = stranger.heard_on("/dn/plan");
    assert_eq!(recorded.len(), 1);
    network.leave(fleet.remove(0).transport);
    fleet[0].events.clear();
    fleet[0].restart(&network);
    fleet[0].node.ask_for_plan();
    for _ in 0..5 {
        recorded.iter().for_each(|(topic, payload)| stranger.say_bytes(topic, payload.clone()));
        pass(&network, &mut fleet, &mut stranger, 1);
    }
    assert_eq!(answers(&fleet[0]), []);
    fleet.push(ground(&network));
    pass(&network, &mut fleet, &mut stranger, 1);
    assert_eq!(answers(&fleet[0]).len(), 1);
}
