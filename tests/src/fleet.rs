//! Nodes on a simulated network and virtual time: whole fleets in one thread, from one seed.

use std::collections::BTreeMap;
use std::time::Duration;

use cosurf_link::{Identity, InboxLimits, MemoryNetwork, MemoryTransport, ModelKey, Node, NodeEvent, Role};
use cosurf_wire::ModelHeader;

use crate::offers::identity;

/// One participant of a simulated fleet, and the contents of its disk.
pub struct Member {
    /// Its name, role and session.
    pub identity: Identity,
    /// The node under test.
    pub node: Node,
    /// Its connection to the network.
    pub transport: MemoryTransport,
    limits: InboxLimits,
    /// Every model that it stored.
    pub disk: BTreeMap<ModelKey, (ModelHeader, Vec<u8>)>,
    /// Number of models that it stored although they were on its disk already.
    pub stored_twice: u32,
    /// Its own models that the other side acknowledged.
    pub uploaded: Vec<ModelKey>,
    /// Everything that its node reported.
    pub events: Vec<NodeEvent>,
    /// Number of upcoming writes that will fail.
    pub failing_writes: u32,
}

impl Member {
    /// Joins the network with an empty disk.
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

    /// Crashes, and starts again in a new session with nothing but its disk.
    pub fn restart(&mut self, network: &MemoryNetwork) {
        let headers: Vec<ModelHeader> = self.disk.values().map(|(header, _)| *header).collect();
        self.identity.session += 1;
        self.node = Node::new(self.identity, self.limits, &headers);
        network.leave(std::mem::replace(&mut self.transport, network.join(&self.identity)));
    }

    /// Steps its node until nothing more is due at the network's present time.
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

/// Runs the fleet and advances time until `is_done`; panics if `deadline` comes first.
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
