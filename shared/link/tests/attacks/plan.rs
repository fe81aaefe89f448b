//! Forged and recorded plans: a drone would photograph, or train on, the wrong ground.

use std::collections::BTreeMap;
use std::time::Duration;

use cosurf_link::{Credentials, NodeEvent, PlannedCell};
use cosurf_tests::fleet::Member;
use cosurf_tests::stranger::Stranger;
use cosurf_wire::{DeviceId, FrameId, Message, Plan, Reply, Topic, VerticalAxis};

use crate::site::{drone_credentials, ground_credentials, keyed_site, network, pass, sealed_by};

fn plans(member: &Member) -> Vec<Option<PlannedCell>> {
    let plan = |event: &NodeEvent| match event {
        NodeEvent::Plan { cell, .. } => Some(cell.clone()),
        _ => None,
    };
    member.events.iter().filter_map(plan).collect()
}

#[test]
fn a_plan_counts_only_from_a_listed_aggregator_and_for_this_session() {
    let network = network();
    let mut fleet = keyed_site(&network);
    let mut stranger = Stranger::new(&network);
    let device = DeviceId::new("drone-1").unwrap();
    let ask = |drone: &mut Member, network| {
        drone.restart(network);
        drone.node.set_credentials(drone_credentials("drone-1"));
        drone.node.ask_for_plan();
        drone.events.clear();
    };
    ask(&mut fleet[1], &network);
    let session = fleet[1].identity.session;
    let topic = Topic::LocalReply { device, reply: Reply::Plan };
    let plan = |session| {
        let (frame, vertical) = (FrameId::default(), VerticalAxis::Z);
        Message::Plan(Plan { device, session, frame, vertical, margin: 0.0, cell: &[] })
    };
    let say = |stranger: &mut Stranger, by: &str, session| {
        let (topic, payload) = sealed_by(by, 1 << 39, 1, topic, &plan(session));
        stranger.say_bytes(&topic, payload);
    };
    stranger.say(topic, &plan(session));
    say(&mut stranger, "eve", session);
    say(&mut stranger, "drone-2", session);
    pass(&network, &mut fleet, &mut stranger, Duration::from_secs(1));
    assert_eq!(plans(&fleet[1]), [], "unsigned, or signed by others");
    assert_eq!(fleet[1].node.forged(), 3);
    say(&mut stranger, "ground", session - 1);
    pass(&network, &mut fleet, &mut stranger, Duration::from_secs(1));
    assert_eq!(plans(&fleet[1]), [], "of another session");

    let corners = vec![[0.0, 0.0], [9.0, 0.0], [0.0, 9.0]];
    let cell = PlannedCell { vertical: VerticalAxis::Z, corners, margin: 0.2 };
    fleet[0].restart(&network);
    fleet[0].node.set_credentials(ground_credentials());
    fleet[0].node.share_plan(BTreeMap::from([(device, cell.clone())]));
    pass(&network, &mut fleet, &mut stranger, Duration::from_secs(1));
    assert_eq!(plans(&fleet[1]), [Some(cell.clone())]);

    // The next mission, with another plan: the recorded answer to the last one does not count.
    let recorded = stranger.heard_on("/drone-1/dn/plan");
    fleet[0].node.share_plan(BTreeMap::new());
    ask(&mut fleet[1], &network);
    for (topic, payload) in &recorded {
        stranger.say_bytes(topic, payload.clone());
    }
    pass(&network, &mut fleet, &mut stranger, Duration::from_secs(3));
    assert!(plans(&fleet[1]).iter().all(Option::is_none) && !plans(&fleet[1]).is_empty());

    // A drone without a list of keys believes whoever answers its session.
    ask(&mut fleet[1], &network);
    fleet[1].node.set_credentials(Credentials { trusted: None, ..drone_credentials("drone-1") });
    network.leave(fleet.remove(0).transport);
    stranger.say(topic, &plan(session + 2));
    pass(&network, &mut fleet, &mut stranger, Duration::from_secs(1));
    assert_eq!(plans(&fleet[0]), [None]);
}
