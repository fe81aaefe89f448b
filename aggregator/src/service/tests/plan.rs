//! The cells of the site's plan that the service tells to devices.

use std::collections::BTreeMap;

use cosurf_link::{Credentials, PlannedCell};
use cosurf_wire::{FrameId, VerticalAxis};

use super::*;

/// What each drone is told: its frame and its cell. All have asked.
fn told(plan: Option<BTreeMap<DeviceId, PlannedCell>>) -> Vec<(String, Option<PlannedCell>)> {
    let folder = tempfile::tempdir().unwrap();
    let network = MemoryNetwork::new(31, Faults::NONE);
    let Ground { service, transport } = open(&network, folder.path(), Expected::Anybody(AT_ONCE));
    let frame = FrameId::new("enu").unwrap();
    let service = service.with(Credentials { frame, ..Credentials::default() });
    let service = plan.into_iter().fold(service, Service::with_plan);
    let mut ground = Ground { service, transport };
    let join = |name| {
        let identity = identity(name, Role::Device);
        let mut node = Node::new(identity, LIMITS, &[]);
        node.ask_for_plan();
        (node, network.join(&identity), None)
    };
    let mut askers = ["drone-1", "drone-2"].map(join);
    while askers.iter().any(|(_, _, answer)| answer.is_none()) {
        let now = network.now();
        assert!(now < Duration::from_secs(2), "at once");
        for (node, transport, answer) in &mut askers {
            if let Some(NodeEvent::Plan { frame, cell }) = node.step(transport, || now, Duration::ZERO) {
                *answer = Some((frame.to_string(), cell));
            }
        }
        step(&network, &mut ground, &mut [], &mut Vec::new());
    }
    askers.map(|(_, _, answer)| answer.unwrap()).to_vec()
}

#[test]
fn each_device_is_told_its_cell_or_that_it_has_none() {
    let corners = vec![[0.0, 0.0], [9.0, 0.0], [0.0, 9.0]];
    let cell = PlannedCell { vertical: VerticalAxis::Z, corners, margin: 0.2 };
    let plan = BTreeMap::from([(DeviceId::new("drone-1").unwrap(), cell.clone())]);
    let none = ("enu".to_owned(), None);
    assert_eq!(told(Some(plan)), [("enu".to_owned(), Some(cell)), none.clone()]);
    assert_eq!(told(None), [none.clone(), none], "without a plan nobody waits");
}
