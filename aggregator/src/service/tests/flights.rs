//! The flights that the service confirms to devices.

use std::collections::BTreeMap;

use cosurf_link::{Credentials, flight_hash};
use cosurf_tests::keys::{key_of, list};
use cosurf_tests::models::cameras;
use cosurf_wire::BodyHash;

use super::*;

/// The service of a site with keys, in the session of this number.
fn open_keyed(network: &MemoryNetwork, folder: &Path, session: u64) -> Ground {
    let identity = Identity { session, ..identity("aggregator", Role::Aggregator) };
    let transport = network.join(&identity);
    let (folder, merge) = (folder.to_path_buf(), MergeSettings::default());
    let expected = Expected::Anybody(AT_ONCE);
    let config = ServiceConfig { identity, folder, limits: LIMITS, expected, merge, threads: 1 };
    let trusted = Some(list(&["agent-1", "agent-2"]));
    let credentials = Credentials { key: Some(key_of("aggregator")), trusted, ..Credentials::default() };
    Ground { service: Service::open(config).unwrap().with(credentials), transport }
}

/// A drone that has announced its flight, and what it was told about flights.
struct Flyer {
    drone: Drone,
    confirmed: BTreeMap<DeviceId, BodyHash>,
}

impl Flyer {
    fn new(network: &MemoryNetwork, name: &str, session: u64, count: usize) -> Self {
        let identity = Identity { session, ..identity(name, Role::Device) };
        let mut node = Node::new(identity, LIMITS, &[]);
        let (trusted, fleet) = (Some(list(&["aggregator"])), Some(list(&["agent-1", "agent-2"])));
        node.set_credentials(Credentials {
            key: Some(key_of(name)),
            trusted,
            fleet,
            ..Credentials::default()
        });
        node.announce_flight(&cameras(count));
        let drone = Drone { node, transport: network.join(&identity), global: None };
        Self { drone, confirmed: BTreeMap::new() }
    }

    fn is_told(&self, device: &str, count: usize) -> bool {
        self.confirmed.get(&DeviceId::new(device).unwrap()) == Some(&flight_hash(&cameras(count)))
    }
}

/// Runs service and drones for some time.
fn pass(network: &MemoryNetwork, ground: &mut Ground, flyers: &mut [Flyer], seconds: u64) {
    let end = network.now() + Duration::from_secs(seconds);
    while network.now() < end {
        let now = network.now();
        for Flyer { drone, confirmed } in flyers.iter_mut() {
            if let Some(NodeEvent::ConfirmedFlights(list)) =
                drone.node.step(&mut drone.transport, || now, Duration::ZERO)
            {
                *confirmed = list;
            }
        }
        step(network, ground, &mut [], &mut Vec::new());
    }
}

/// Starts the service again, lets it run for 100 s with the same flyers, and returns it.
fn again(network: &MemoryNetwork, ground: Ground, folder: &Path, flyers: &mut [Flyer]) -> Ground {
    network.leave(ground.transport);
    drop(ground.service);
    let mut ground = open_keyed(network, folder, 101);
    flyers.iter_mut().for_each(|flyer| flyer.confirmed.clear());
    pass(network, &mut ground, flyers, 100);
    ground
}

/// The same flyers, the first one of them with its next flight, of four cameras.
fn with_next_flight(network: &MemoryNetwork, [agent_1, agent_2]: [Flyer; 2]) -> [Flyer; 2] {
    network.leave(agent_1.drone.transport);
    [Flyer::new(network, "agent-1", 120, 4), agent_2]
}

/// A withdrawn flight stays withdrawn, although its drone is there and pledges it again and again, and although the service
/// starts again. A later flight of the drone counts.
#[test]
fn attack_11_a_withdrawn_flight_is_not_confirmed_again() {
    let folder = tempfile::tempdir().unwrap();
    let network = MemoryNetwork::new(11, Faults::NONE);
    let mut ground = open_keyed(&network, folder.path(), 100);
    let mut flyers = [Flyer::new(&network, "agent-1", 50, 3), Flyer::new(&network, "agent-2", 60, 2)];
    pass(&network, &mut ground, &mut flyers, 5);
    assert!(flyers.iter().all(|flyer| flyer.is_told("agent-1", 3) && flyer.is_told("agent-2", 2)));

    withdraw(folder.path(), &DeviceId::new("agent-1").unwrap()).unwrap();
    pass(&network, &mut ground, &mut flyers, 100);
    assert!(!flyers[1].is_told("agent-1", 3) && flyers[1].is_told("agent-2", 2));

    let mut ground = again(&network, ground, folder.path(), &mut flyers);
    assert!(!flyers[1].is_told("agent-1", 3), "it has pledged to the new session, too");
    assert!(flyers[1].is_told("agent-2", 2));

    let mut flyers = with_next_flight(&network, flyers);
    pass(&network, &mut ground, &mut flyers, 5);
    assert!(flyers[1].is_told("agent-1", 4), "a later flight");
}

/// Nobody leaves ground to a device that is revoked, although it is there, and although the service starts again. Once it is let in
/// again, its flight counts.
#[test]
fn the_flight_of_a_revoked_device_takes_no_ground_from_others() {
    let folder = tempfile::tempdir().unwrap();
    let network = MemoryNetwork::new(12, Faults::NONE);
    let mut ground = open_keyed(&network, folder.path(), 100);
    let mut flyers = [Flyer::new(&network, "agent-1", 50, 3), Flyer::new(&network, "agent-2", 60, 2)];
    pass(&network, &mut ground, &mut flyers, 5);
    assert!(flyers[1].is_told("agent-1", 3) && flyers[1].is_told("agent-2", 2));

    let device = DeviceId::new("agent-1").unwrap();
    revoke(folder.path(), &device).unwrap();
    pass(&network, &mut ground, &mut flyers, 30);
    assert!(!flyers[1].is_told("agent-1", 3) && flyers[1].is_told("agent-2", 2));

    let mut ground = again(&network, ground, folder.path(), &mut flyers);
    assert!(!flyers[1].is_told("agent-1", 3), "it pledges to the new session, too");
    assert!(flyers[1].is_told("agent-2", 2));

    assert!(readmit(folder.path(), &device).unwrap());
    let mut flyers = with_next_flight(&network, flyers);
    pass(&network, &mut ground, &mut flyers, 30);
    assert!(flyers[1].is_told("agent-1", 4), "it is let in again");
}
