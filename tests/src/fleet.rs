//! Simulated fleets: nodes ([`Node`]) on a simulated network, with virtual time. A whole fleet runs in one thread,
//! and the same seed gives the same run.

use std::collections::BTreeMap;
use std::time::Duration;

use cosurf_link::{Identity, InboxLimits, MemoryNetwork, MemoryTransport, ModelKey, Node, NodeEvent, Role};
use cosurf_wire::ModelHeader;

use crate::offers::identity;

/// A participant of a simulated fleet: its node, and the contents of its disk.
pub struct Member {
    /// Name, role and session of the participant.
    pub identity: Identity,
    /// The node under test.
    pub node: Node,
    /// Connection of the node to the simulated network.
    pub transport: MemoryTransport,
    limits: InboxLimits,
    /// The simulated disk: every model that the participant has stored.
    pub disk: BTreeMap<ModelKey, (ModelHeader, Vec<u8>)>,
    /// Number of times that a model was stored although it was on the disk already.
    pub stored_twice: u32,
    /// Models of this participant that a receiver has acknowledged.
    pub uploaded: Vec<ModelKey>,
    /// All events that the node has reported.
    pub events: Vec<NodeEvent>,
    /// Number of writes to the disk that will still fail before writes succeed again.
    pub failing_writes: u32,
}

impl Member {
    /// Makes a participant with an empty disk, and connects it to the network.
    pub fn new(network: &MemoryNetwork, role: Role, device: &str, limits: InboxLimits) -> Self {
        let identity = identity(role, device);
        Self {
            identity,
            node: Node::new(identity, limits, &[]),
            transport: network.join(&identity),
            limits,
            disk: BTreeMap::new(),
            stored_twice: 0,
            uploaded: Vec::new(),
            events: Vec::new(),
            failing_writes: 0,
        }
    }

    /// Simulates a crash and a restart: the participant starts a new session, and keeps nothing but its disk.
    pub fn restart(&mut self, network: &MemoryNetwork) {
        let headers: Vec<ModelHeader> = self.disk.values().map(|(header, _)| *header).collect();
        self.identity.session += 1;
        self.node = Node::new(self.identity, self.limits, &headers);
        network.leave(std::mem::replace(&mut self.transport, network.join(&self.identity)));
    }

    /// Steps the node until nothing more is due at the network's present time.
    pub fn work(&mut self, network: &MemoryNetwork) {
        let mut idle = 0;
        while idle < 2 {
            match self.node.step(&mut self.transport, || network.now(), Duration::ZERO) {
                Some(event) => {
                    idle = 0;
                    self.take(event);
                }
                None => idle += 1,
            }
        }
    }

    fn take(&mut self, event: NodeEvent) {
        match &event {
            NodeEvent::Store { header, body } if self.failing_writes == 0 => {
                let before = self.disk.insert(header.into(), (*header, body.to_vec()));
                self.stored_twice += u32::from(before.is_some());
                self.node.stored(header.into());
            }
            NodeEvent::Store { header, .. } => {
                self.failing_writes -= 1;
                self.node.store_failed(header.into());
            }
            NodeEvent::Uploaded(key, _) => self.uploaded.push(*key),
            _ => {}
        }
        self.events.push(event);
    }

    fn last_events(&self) -> String {
        let last: Vec<&NodeEvent> = self.events.iter().rev().take(3).collect();
        format!("{}: {last:#?}\n", self.identity.device)
    }
}

/// Runs the fleet and advances the virtual time until `is_done` returns true. Panics if the time reaches `deadline`
/// first.
pub fn run_until(
    network: &MemoryNetwork,
    members: &mut [Member],
    deadline: Duration,
    mut is_done: impl FnMut(&mut [Member]) -> bool,
) {
    loop {
        members.iter_mut().for_each(|member| member.work(network));
        if is_done(members) {
            return;
        }
        let now = network.now();
        let events = || members.iter().map(Member::last_events).collect::<String>();
        assert!(now < deadline, "not done after {now:?}\n{}", events());
        let wakeups = members.iter().filter_map(|member| member.node.next_wakeup());
        let next = wakeups.min().unwrap_or(deadline);
        network.advance(next.clamp(now + Duration::from_millis(1), now + Duration::from_secs(1)));
    }
}
