//! The names, keys and models of those who take part.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::sync::OnceLock;

use cosurf_link::{Credentials, Manifest, Offer, PlannedCell, Receiver, TileEntry};
use cosurf_tests::dice::Dice;
use cosurf_tests::keys::{key_of, list};
use cosurf_tests::models::{cameras, random_splats};
use cosurf_wire::{DeviceId, ModelHeader, ModelId, ModelKind, SiteId, VerticalAxis};

/// The site of the drones, and the site of the aggregator above it.
pub(crate) const SITES: [&str; 2] = ["quarry", "region"];
/// The aggregator of the drones' site. At the site above it is a device.
pub(crate) const GROUND: &str = "ground";
/// The aggregator of the site above.
pub(crate) const CLOUD: &str = "cloud";
/// The drone that sends its models to the site above.
pub(crate) const FAR_DRONE: &str = "drone-9";
/// The hostile participant with a listed key, or with a password.
pub(crate) const INSIDER: &str = "mallory";

/// Numbers of splats of the models: bodies of 200 bytes to 8 kB.
const SPLATS: [usize; 8] = [4, 12, 25, 50, 80, 130, 260, 560];

pub(crate) fn site(index: usize) -> SiteId {
    SiteId::new(SITES[index]).unwrap()
}

pub(crate) fn device(name: &str) -> DeviceId {
    DeviceId::new(name).unwrap()
}

pub(crate) fn drone(index: usize) -> String {
    format!("drone-{index}")
}

/// The cell of a drone in the plan that its aggregator shares: odd drones have one.
pub(crate) fn planned(device: DeviceId) -> Option<PlannedCell> {
    let corners = vec![[0.0, 0.0], [90.0, 0.0], [0.0, 90.0]];
    let is_planned = (1..9).step_by(2).any(|index| device == self::device(&drone(index)));
    is_planned.then_some(PlannedCell { vertical: VerticalAxis::Z, corners, margin: 0.2 })
}

/// A model of 4 to 560 splats. Its body comes from a pool, so that a conversation does not pack it anew.
pub(crate) fn model(
    device: DeviceId,
    number: ModelId,
    kind: ModelKind,
    seed: u64,
    chunk_bytes: u32,
) -> Offer {
    static POOL: OnceLock<Vec<Offer>> = OnceLock::new();
    let pack = |i: usize| {
        let (splats, views) = (random_splats(i as u64, SPLATS[i % SPLATS.len()], 0), cameras(i % 3));
        Offer::new(DeviceId::new("pool").unwrap(), ModelId(1), ModelKind::Local, 3, &splats, &views).unwrap()
    };
    let pool = POOL.get_or_init(|| (0..64).map(pack).collect());
    let mut offer = pool[seed as usize % pool.len()].clone();
    offer.header = ModelHeader { device, model: number, kind, chunk_bytes, ..offer.header };
    offer
}

/// The manifest of a global model with two tiles for each drone, and the tiles.
pub(crate) fn tiles(dice: &mut Dice, drones: usize, chunk_bytes: u32) -> (Offer, Vec<Offer>) {
    let (ground, revision) = (device(GROUND), ModelId(1));
    let tile = |index: usize, seed: u64| {
        model(ground, ModelId::of_tile(revision, index), ModelKind::Global, seed, chunk_bytes)
    };
    let tiles: Vec<Offer> = (0..2 * drones).map(|index| tile(index, dice.bits())).collect();
    let entry = |offer: &Offer| {
        let ModelHeader { model, blake3, splats, body_bytes, bounds, .. } = offer.header;
        TileEntry { model, blake3, splats, body_bytes, bounds }
    };
    let receiver =
        |i: usize| Receiver { device: device(&drone(1 + i)), tiles: vec![2 * i as u32, 2 * i as u32 + 1] };
    let manifest = Manifest {
        tiles: tiles.iter().map(entry).collect(),
        receivers: (0..drones).map(receiver).collect(),
        ..Manifest::default()
    };
    (Offer::of_manifest(ground, revision, 3, &manifest).unwrap(), tiles)
}

/// The credentials of the participant `name` of a site with keys. `trusted` and `fleet` are the names in its lists.
pub(crate) fn credentials(name: &str, trusted: &[&str], fleet: Option<&[&str]>) -> Credentials {
    type Made = BTreeMap<String, Credentials>;
    thread_local!(static MADE: RefCell<Made> = const { RefCell::new(Made::new()) });
    let make = || Credentials {
        key: Some(key_of(name)),
        trusted: Some(list(trusted)),
        fleet: fleet.map(list),
        ..Credentials::default()
    };
    let text = format!("{name} {trusted:?} {fleet:?}");
    MADE.with_borrow_mut(|made| made.entry(text).or_insert_with(make).clone())
}
