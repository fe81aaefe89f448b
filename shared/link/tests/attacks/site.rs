//! A site whose participants have keys, on a simulated network.

use std::num::NonZeroU32;
use std::time::Duration;

use cosurf_link::{Credentials, Faults, InboxLimits, MemoryNetwork, NodeEvent, Role};
use cosurf_tests::fleet::Member;
use cosurf_tests::keys::{Signer, key_of, list};
use cosurf_tests::stranger::Stranger;
use cosurf_wire::{Message, Sealed, SiteId, Topic};

/// A site with an aggregator `ground` and the drones `drone-1` and `drone-2`, all with keys. The drones list each other
/// for their flights.
pub(crate) fn keyed_site(network: &MemoryNetwork) -> Vec<Member> {
    let mut ground = Member::new(network, Role::Aggregator, "ground", InboxLimits::default());
    ground.node.set_credentials(ground_credentials());
    let drone = |name: &str| {
        let mut drone = Member::new(network, Role::Device, name, InboxLimits::default());
        drone.node.set_credentials(drone_credentials(name));
        drone
    };
    vec![ground, drone("drone-1"), drone("drone-2")]
}

/// The credentials of the aggregator of [`keyed_site`].
pub(crate) fn ground_credentials() -> Credentials {
    let trusted = Some(list(&["drone-1", "drone-2"]));
    Credentials { key: Some(key_of("ground")), trusted, ..Credentials::default() }
}

/// The credentials of a drone of [`keyed_site`].
pub(crate) fn drone_credentials(name: &str) -> Credentials {
    Credentials {
        key: Some(key_of(name)),
        trusted: Some(list(&["ground"])),
        fleet: Some(list(&["drone-1", "drone-2"])),
        ..Credentials::default()
    }
}

/// A network without faults.
pub(crate) fn network() -> MemoryNetwork {
    MemoryNetwork::new(1, Faults::NONE)
}

/// A network whose lines carry 20 kB/s, so that other messages come between those of an upload.
pub(crate) fn slow_network() -> MemoryNetwork {
    MemoryNetwork::new(1, Faults { bytes_per_s: NonZeroU32::new(20_000), ..Faults::NONE })
}

/// A site without keys: an aggregator `ground` with these limits, and drones with these names.
pub(crate) fn open_site(network: &MemoryNetwork, limits: InboxLimits, drones: &[&str]) -> Vec<Member> {
    let ground = Member::new(network, Role::Aggregator, "ground", limits);
    let drone = |name: &&str| Member::new(network, Role::Device, name, InboxLimits::default());
    std::iter::once(ground).chain(drones.iter().map(drone)).collect()
}

/// Lets time pass. `members` must be all that are connected.
pub(crate) fn pass(network: &MemoryNetwork, members: &mut [Member], stranger: &mut Stranger, time: Duration) {
    let end = network.now() + time;
    while network.now() < end {
        members.iter_mut().for_each(|member| member.work(network));
        stranger.listen();
        network.advance(end.min(network.now() + Duration::from_millis(20)));
    }
}

/// Seals a message as a participant that misuses its key.
pub(crate) fn sealed_by(
    name: &str,
    session: u64,
    count: u64,
    topic: Topic,
    message: &Message<'_>,
) -> (String, Vec<u8>) {
    let topic = topic.to_text(&SiteId::new("site").unwrap());
    let out = Signer::of(name).seal(&topic, message, session, count);
    assert!(Sealed::decode(&out).unwrap().seal.is_some());
    (topic.as_str().to_owned(), out)
}

/// Whether a member was told that its model is refused.
pub(crate) fn is_refused(member: &Member) -> bool {
    member.events.iter().any(|event| matches!(event, NodeEvent::UploadRefused { .. }))
}
