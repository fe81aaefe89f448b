//! The limit on devices: requests of further devices for a global model are not answered, and the aggregator's caller is
//! told.
#![allow(clippy::unwrap_used)]

use std::time::Duration;

use cosurf_link::{Faults, Identity, InboxLimits, MemoryNetwork, Node, NodeEvent, Offer, Role};
use cosurf_scene::Splats;
use cosurf_wire::{DeviceId, ModelId, ModelKind, SiteId, TileId};

const LIMITS: InboxLimits =
    InboxLimits { body_bytes_max: 1 << 20, total_bytes_max: 1 << 20, models_max: 2, stored_max: 2 };

fn identity(name: &str, role: Role) -> Identity {
    Identity { site: SiteId::new("site").unwrap(), device: DeviceId::new(name).unwrap(), session: 1, role }
}

/// Offers a global model to two devices. Returns how many have it after a minute, and how often the aggregator's caller was
/// told that a device is one too many.
fn served(devices_max: usize) -> (usize, usize) {
    let network = MemoryNetwork::new(1, Faults::NONE);
    let ground = identity("ground", Role::Aggregator);
    let mut splats = Splats::with_capacity(1, 0);
    splats.push([0.0; 3], [1.0, 0.0, 0.0, 0.0], [-2.0; 3], 1.0, &[0.5; 3]);
    let mut above = (Node::new(ground, LIMITS, &[]), network.join(&ground));
    above.0.set_devices_max(devices_max);
    let offer = Offer::new(ground.device, ModelId(1), ModelKind::Global, 1, &splats, &[]).unwrap();
    above.0.broadcast(TileId::WHOLE, offer, &[]);
    let mut devices = ["a", "b"].map(|name| {
        let identity = identity(name, Role::Device);
        (Node::new(identity, LIMITS, &[]), network.join(&identity))
    });
    let (mut stored, mut told) = (0, 0);
    while network.now() < Duration::from_secs(60) {
        let now = network.now();
        if let Some(NodeEvent::TooManyDevices { devices_max: limit, .. }) =
            above.0.step(&mut above.1, || now, Duration::ZERO)
        {
            assert_eq!(limit, devices_max);
            told += 1;
        }
        for (node, transport) in &mut devices {
            if let Some(NodeEvent::Store { header, .. }) = node.step(transport, || now, Duration::ZERO) {
                node.stored(header.into());
                stored += 1;
            }
        }
        network.advance(now + Duration::from_millis(5));
    }
    (stored, told)
}

#[test]
fn a_device_beyond_the_limit_is_told_once_by_its_session_and_once_by_the_model() {
    assert_eq!(served(1).1, 2);
    // The aggregator hears its own session too.
    assert_eq!(served(3), (2, 0), "within the limit, both devices have the model");
}
