//! Made-up models, and a fleet on virtual time.
#![allow(clippy::unwrap_used, dead_code, missing_docs, unreachable_pub)]

use std::collections::BTreeMap;
use std::sync::OnceLock;
use std::time::Duration;

use cosurf_link::{
    Identity, InboxLimits, MemoryNetwork, MemoryTransport, ModelKey, Node, NodeEvent, Offer, Role,
};
use cosurf_scene::{Camera, Pose, Splats};
use cosurf_wire::{DeviceId, ModelHeader, ModelId, ModelKind, SiteId};
use glam::{DQuat, DVec2, DVec3};

pub fn identity(role: Role, device: &str) -> Identity {
    let (site, device) = (SiteId::new("site").unwrap(), DeviceId::new(device).unwrap());
    Identity { site, device, session: 7, role }
}

/// Pseudo-random floats in -1..1, another sequence for each seed.
pub fn noise(seed: u64) -> impl FnMut() -> f32 {
    let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
    move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 40) as f32 / (1u64 << 23) as f32 - 1.0
    }
}

pub fn splats(seed: u64, count: usize, sh_degree: u32) -> Splats {
    let mut splats = Splats::with_capacity(count, sh_degree);
    let mut noise = noise(seed);
    for _ in 0..count {
        let mean = [100.0 * noise(), 100.0 * noise(), 10.0 * noise()];
        let quat = [1.5 + noise(), noise(), noise(), noise()];
        let log_scale = [3.0 * noise(), 3.0 * noise(), 3.0 * noise()];
        let logit = 5.0 * noise();
        let sh: Vec<f32> = (0..splats.sh_stride()).map(|_| noise()).collect();
        splats.push(mean, quat, log_scale, logit, &sh);
    }
    splats
}

pub fn cameras(count: usize) -> Vec<Camera> {
    let camera = |i: usize| Camera {
        cam_from_world: Pose {
            rotation: DQuat::from_rotation_x(0.1 * i as f64),
            translation: DVec3::new(i as f64, 0.1, -3.3),
        },
        focal_px: DVec2::new(500.25, 501.5),
        center_px: DVec2::new(319.1 + i as f64, 240.7),
        size_px: [640, 480],
    };
    (0..count).map(camera).collect()
}

/// An offer of `count` splats of degree 0 (56 bytes each) in chunks of `chunk_bytes`.
pub fn offer(device: &str, model: u64, kind: ModelKind, seed: u64, count: usize, chunk_bytes: u32) -> Offer {
    let device = DeviceId::new(device).unwrap();
    let mut offer =
        Offer::new(device, ModelId(model), kind, 3, &splats(seed, count, 0), &cameras(3)).unwrap();
    offer.header.chunk_bytes = chunk_bytes;
    offer
}

/// An offer of `count` splats that its cameras see all: who merges believes no other.
pub fn credible(device: &str, count: usize) -> Offer {
    let mut views = cameras(3);
    for view in &mut views {
        view.cam_from_world.rotation = DQuat::IDENTITY;
        view.cam_from_world.translation.z = 300.0;
    }
    let device = DeviceId::new(device).unwrap();
    Offer::new(device, ModelId(1), ModelKind::Local, 3, &splats(1, count, 0), &views).unwrap()
}

/// As [`offer`], of 16 to 1,000 splats, from a pool that is packed once: for tests of thousands of seeds.
pub fn pooled(device: &str, model: u64, kind: ModelKind, seed: u64, chunk_bytes: u32) -> Offer {
    static POOL: OnceLock<Vec<Offer>> = OnceLock::new();
    let pack = |i: u64| offer("pool", 1, ModelKind::Local, i, 16 + (i as usize * 61) % 985, 1024);
    let pool = POOL.get_or_init(|| (0..64).map(pack).collect());
    let mut offer = pool[(seed % 64) as usize].clone();
    offer.header = ModelHeader {
        device: DeviceId::new(device).unwrap(),
        model: ModelId(model),
        kind,
        chunk_bytes,
        ..offer.header
    };
    offer
}

/// One participant of a simulated fleet, and what its disk holds.
pub struct Member {
    pub identity: Identity,
    pub node: Node,
    pub transport: MemoryTransport,
    limits: InboxLimits,
    pub disk: BTreeMap<ModelKey, (ModelHeader, Vec<u8>)>,
    /// Writes of what was on the disk already.
    pub stored_twice: u32,
    pub uploaded: Vec<ModelKey>,
    pub events: Vec<NodeEvent>,
    /// The next so many writes fail.
    pub full_disk_for: u32,
}

impl Member {
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
            full_disk_for: 0,
        }
    }

    /// Dies without a word and comes back with nothing but its disk.
    pub fn restart(&mut self, network: &MemoryNetwork) {
        let headers: Vec<ModelHeader> = self.disk.values().map(|(header, _)| *header).collect();
        self.identity.session += 1;
        self.node = Node::new(self.identity, self.limits, &headers);
        network.leave(std::mem::replace(&mut self.transport, network.join(&self.identity)));
    }

    /// Works until there is nothing more to do at this moment.
    pub fn work(&mut self, network: &MemoryNetwork) {
        let mut idle = 0;
        while idle < 2 {
            match self.node.step(&mut self.transport, || network.now(), Duration::ZERO) {
                Some(event) => {
                    idle = 0;
                    self.take(event);
                }
                None if self.node.next_wakeup().is_some_and(|at| at <= network.now()) => idle += 1,
                None => idle += 1,
            }
        }
    }

    fn take(&mut self, event: NodeEvent) {
        match &event {
            NodeEvent::Store { header, body } if self.full_disk_for == 0 => {
                let before = self.disk.insert(header.into(), (*header, body.to_vec()));
                self.stored_twice += u32::from(before.is_some());
                self.node.stored(header.into());
            }
            NodeEvent::Store { header, .. } => {
                self.full_disk_for -= 1;
                self.node.store_failed(header.into());
            }
            NodeEvent::Uploaded(key, _) => self.uploaded.push(*key),
            _ => {}
        }
        self.events.push(event);
    }
}

/// Runs the fleet until `done`, or panics at `deadline`.
pub fn run(
    network: &MemoryNetwork,
    members: &mut [Member],
    deadline: Duration,
    mut done: impl FnMut(&mut [Member]) -> bool,
) {
    loop {
        members.iter_mut().for_each(|member| member.work(network));
        if done(members) {
            return;
        }
        let last = |member: &Member| {
            format!(
                "{}: {:#?}",
                member.identity.device,
                member.events.iter().rev().take(3).collect::<Vec<_>>()
            )
        };
        assert!(
            network.now() < deadline,
            "not done after {:?}\n{}",
            network.now(),
            members.iter().map(last).collect::<String>()
        );
        let wakeups = members.iter().filter_map(|member| member.node.next_wakeup());
        let (soonest, latest) = (Duration::from_millis(1), Duration::from_secs(1));
        let next = wakeups.min().unwrap_or(deadline);
        network.advance(next.clamp(network.now() + soonest, network.now() + latest));
    }
}
