//! Uploads of random models, and identities of participants.

use std::net::SocketAddr;
use std::sync::OnceLock;

use cosurf_link::{BrokerAddress, Identity, Offer, Role};
use cosurf_wire::{DeviceId, ModelHeader, ModelId, ModelKind, SiteId};
use glam::DQuat;

use crate::models::{cameras, random_splats};

/// The identity of a participant, at the site called `site` and in session 7.
pub fn identity(role: Role, device: &str) -> Identity {
    let (site, device) = (SiteId::new("site").unwrap(), DeviceId::new(device).unwrap());
    Identity { site, device, session: 7, role }
}

/// The address of a broker that listens at `at`, without TLS.
pub fn broker_address(at: SocketAddr) -> BrokerAddress {
    BrokerAddress::plain(at.ip().to_string(), at.port())
}

/// An upload of `count` random splats (spherical harmonics of degree 0) and three cameras, in chunks of
/// `chunk_bytes`.
pub fn offer(device: &str, model: u64, kind: ModelKind, seed: u64, count: usize, chunk_bytes: u32) -> Offer {
    let device = DeviceId::new(device).unwrap();
    let splats = random_splats(seed, count, 0);
    let mut offer = Offer::new(device, ModelId(model), kind, 3, &splats, &cameras(3)).unwrap();
    offer.header.chunk_bytes = chunk_bytes;
    offer
}

/// An upload of `count` random splats. All splats lie in front of its three cameras, so that the aggregator merges
/// the model.
pub fn mergeable_offer(device: &str, count: usize) -> Offer {
    let mut views = cameras(3);
    for view in &mut views {
        view.cam_from_world.rotation = DQuat::IDENTITY;
        view.cam_from_world.translation.z = 300.0;
    }
    let device = DeviceId::new(device).unwrap();
    Offer::new(device, ModelId(1), ModelKind::Local, 3, &random_splats(1, count, 0), &views).unwrap()
}

/// Like [`offer`], with 16 to 1,000 splats. The body comes from a pool of 64 bodies that are packed only once, so
/// that a test can run thousands of seeds.
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
