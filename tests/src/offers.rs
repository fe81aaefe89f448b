//! Uploads of random models, and the identities that send them.

use std::net::SocketAddr;
use std::sync::OnceLock;

use cosurf_link::{BrokerAddress, Identity, Offer, Role};
use cosurf_wire::{DeviceId, ModelHeader, ModelId, ModelKind, SiteId};
use glam::DQuat;

use crate::models::{cameras, random_splats};

/// A participant of the site `site`, in session 7.
pub fn identity(role: Role, device: &str) -> Identity {
    let (site, device) = (SiteId::new("site").unwrap(), DeviceId::new(device).unwrap());
    Identity { site, device, session: 7, role }
}

/// The address of a broker in this process, without TLS.
pub fn broker_address(at: SocketAddr) -> BrokerAddress {
    BrokerAddress { host: at.ip().to_string(), port: at.port(), is_tls: false }
}

/// An upload of `count` random splats of degree 0 and three cameras, in chunks of `chunk_bytes`.
pub fn offer(device: &str, model: u64, kind: ModelKind, seed: u64, count: usize, chunk_bytes: u32) -> Offer {
    let device = DeviceId::new(device).unwrap();
    let splats = random_splats(seed, count, 0);
    let mut offer = Offer::new(device, ModelId(model), kind, 3, &splats, &cameras(3)).unwrap();
    offer.header.chunk_bytes = chunk_bytes;
    offer
}

/// An upload of `count` random splats that its cameras see from above, so that the aggregator merges it.
pub fn mergeable_offer(device: &str, count: usize) -> Offer {
    let mut views = cameras(3);
    for view in &mut views {
        view.cam_from_world.rotation = DQuat::IDENTITY;
        view.cam_from_world.translation.z = 300.0;
    }
    let device = DeviceId::new(device).unwrap();
    Offer::new(device, ModelId(1), ModelKind::Local, 3, &random_splats(1, count, 0), &views).unwrap()
}

/// As [`offer`], of 16 to 1,000 splats, from 64 uploads that are packed once: for tests of thousands of seeds.
pub fn pooled_offer(device: &str, model: u64, kind: ModelKind, seed: u64, chunk_bytes: u32) -> Offer {
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
