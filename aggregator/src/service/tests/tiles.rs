//! A global model that is too large to be sent whole: each drone gets the tiles of its own ground.

use cosurf_scene::LocalFrame;
use std::collections::BTreeSet;

use cosurf_link::{Complete, InboxLimits, Received};
use tempfile::TempDir;

use super::damage::{SWEPT, copy, list_files};
use super::*;
use crate::testing::{above, ground};

/// Limits of a drone that gets many tiles.
const MANY_TILES: InboxLimits = InboxLimits { stored_max: 100, ..LIMITS };

/// A drone that sends one model and keeps what it receives on disk.
struct Keeping {
    node: Node,
    transport: MemoryTransport,
    folder: TempDir,
    received: Received,
    complete: Option<Complete>,
    /// The tiles that it received, in this life.
    tiles: BTreeSet<ModelKey>,
}

/// A model of the ground from x = `west` to `west` + 4.
fn strip(west: f32) -> Model {
    Model { splats: ground(west, west + 4.0), cameras: vec![above(f64::from(west) + 2.0)] }
}

impl Keeping {
    fn new(network: &MemoryNetwork, name: &str, west: f32) -> Self {
        Self::with_an_empty_folder(network, identity(name, Role::Device), west)
    }

    fn with_an_empty_folder(network: &MemoryNetwork, identity: Identity, west: f32) -> Self {
        let Model { splats, cameras } = strip(west);
        let offer = Offer::new(identity.device, ModelId(1), ModelKind::Local, 3, &splats, &cameras);
        let mut node = Node::new(identity, MANY_TILES, &[]);
        node.upload(offer.unwrap());
        let (transport, folder) = (network.join(&identity), tempfile::tempdir().unwrap());
        let (received, _) = open_received(identity.device.as_str(), folder.path());
        Self { node, transport, folder, received, complete: None, tiles: BTreeSet::new() }
    }

    fn step(&mut self, now: Duration) {
        let complete = match self.node.step(&mut self.transport, || now, Duration::ZERO) {
            Some(NodeEvent::Store { header, body }) => {
                self.tiles.extend(header.model.is_tile().then_some(ModelKey::from(header)));
                self.received.take(&mut self.node, header, &body).unwrap()
            }
            Some(NodeEvent::Known(header)) => self.received.known(&mut self.node, header).unwrap(),
            _ => None,
        };
        self.complete = complete.or(self.complete);
    }

    /// The x of all splats that it has.
    fn xs(&self) -> Vec<f32> {
        let splats = ply::read(&self.folder.path().join("global.ply"), &LocalFrame::WORLD).unwrap();
        splats.means.iter().map(|mean| mean[0]).collect()
    }
}

fn open_received(name: &str, folder: &Path) -> (Received, Vec<ModelHeader>) {
    let ply = folder.join("global.ply");
    Received::open(DeviceId::new(name).unwrap(), &folder.join("global"), ply).unwrap()
}

/// A service that sends a global model of more than 100 splats in tiles of at most 25. It does not distil: all models
/// together are one tile of a distillation, so all splats would change with each model.
fn open_tiled(network: &MemoryNetwork, folder: &Path) -> Ground {
    let merge = MergeSettings { vouched: true, epochs: 0, ..MergeSettings::default() };
    let mut ground = open_with(network, folder, Expected::Anybody(AT_ONCE), merge);
    ground.service.keeper.work.whole_splats_max = 100;
    ground
}

/// Runs until all drones have the newest revision and the service knows it.
fn fly(network: &MemoryNetwork, ground: &mut Ground, drones: &mut [Keeping], models: usize) -> ModelId {
    let mut events = Vec::new();
    loop {
        let now = network.now();
        drones.iter_mut().for_each(|drone| drone.step(now));
        step(network, ground, &mut [], &mut events);
        let merged = events.iter().rev().find_map(|event| match event {
            ServiceEvent::Merged { header, models, .. } => Some((header.model, *models)),
            _ => None,
        });
        let Some((revision, of)) = merged else { continue };
        let have = |drone: &Keeping| drone.complete.is_some_and(|complete| complete.revision == revision);
        let since = events.iter().rev().take_while(|event| !is_merged(event));
        let is_told =
            count(&since.cloned().collect::<Vec<_>>(), |event| *event == ServiceEvent::Delivered) == 1;
        if of == models && drones.iter().all(have) && is_told {
            return revision;
        }
    }
}

#[test]
fn each_drone_gets_the_tiles_of_its_ground_and_of_the_next_revision_only_what_changed() {
    for seed in 30..33 {
        let folder = tempfile::tempdir().unwrap();
        let network = MemoryNetwork::new(seed, BAD_WEATHER);
        let mut ground = open_tiled(&network, folder.path());
        let mut drones = vec![Keeping::new(&network, "west", -10.0), Keeping::new(&network, "east", 2.0)];
        fly(&network, &mut ground, &mut drones, 2);
        let [west, east] = [drones[0].xs(), drones[1].xs()];
        assert!(west.iter().all(|x| *x < 0.0) && east.iter().all(|x| *x > 0.0), "seed {seed}");
        let all = ply::read(&global_ply(folder.path()), &LocalFrame::WORLD).unwrap();
        let of = |is_west: bool| all.means.iter().filter(|mean| (mean[0] < 0.0) == is_west).count();
        assert_eq!((west.len(), east.len()), (of(true), of(false)), "seed {seed}: all splats of its ground");
        assert!(drones[0].tiles.len() > 4, "seed {seed}: a tile has at most 25 of {} splats", west.len());
        // A third drone changes nothing in the west. It is given the tiles that it shares with the east.
        drones.iter_mut().for_each(|drone| drone.tiles.clear());
        drones.push(Keeping::new(&network, "far", 10.0));
        let revision = fly(&network, &mut ground, &mut drones, 3);
        assert_eq!(drones[0].tiles.len(), 0, "seed {seed}: nothing has changed in the west");
        assert!(drones[2].xs().iter().all(|x| *x >= 10.0), "seed {seed}");
        // A restarted service offers the same tiles; a restarted drone has them.
        drop(ground);
        let network = MemoryNetwork::new(seed + 100, BAD_WEATHER);
        let mut ground = open_tiled(&network, folder.path());
        let old = std::mem::take(&mut drones);
        let mut drones: Vec<Keeping> = old
            .into_iter()
            .zip(["west", "east", "far"])
            .map(|(drone, name)| {
                let (received, known) = open_received(name, drone.folder.path());
                let identity = identity(name, Role::Device);
                let node = Node::new(identity, MANY_TILES, &known);
                let transport = network.join(&identity);
                Keeping { node, transport, received, complete: None, tiles: BTreeSet::new(), ..drone }
            })
            .collect();
        assert_eq!(fly(&network, &mut ground, &mut drones, 3), revision, "seed {seed}");
        assert!(drones.iter().all(|drone| drone.tiles.is_empty()), "seed {seed}");
    }
}

#[test]
fn a_model_that_has_become_small_is_sent_whole_again() {
    let folder = tempfile::tempdir().unwrap();
    let network = MemoryNetwork::new(40, BAD_WEATHER);
    let mut ground = open_tiled(&network, folder.path());
    let mut drones = vec![Keeping::new(&network, "west", -10.0), Keeping::new(&network, "east", 2.0)];
    let tiled = fly(&network, &mut ground, &mut drones, 2);
    ground.service.keeper.work.whole_splats_max = usize::MAX;
    drones.push(Keeping::new(&network, "far", 10.0));
    let mut events = Vec::new();
    while drones.iter().any(|drone| drone.complete.is_none_or(|complete| complete.revision <= tiled)) {
        let now = network.now();
        drones.iter_mut().for_each(|drone| drone.step(now));
        step(&network, &mut ground, &mut [], &mut events);
    }
    let all = ply::read(&global_ply(folder.path()), &LocalFrame::WORLD).unwrap().len();
    assert!(drones.iter().all(|drone| drone.xs().len() == all), "all have the whole model");
    assert_eq!(fs::read_dir(folder.path().join("sent")).unwrap().count(), 0, "no tiles are left");
}

#[test]
fn a_restored_revision_is_sent_in_tiles() {
    let folder = tempfile::tempdir().unwrap();
    let network = MemoryNetwork::new(43, Faults::NONE);
    let mut ground = open_tiled(&network, folder.path());
    let mut drones = vec![Keeping::new(&network, "west", -10.0), Keeping::new(&network, "east", 2.0)];
    let first = fly(&network, &mut ground, &mut drones, 2);
    let before = ply::read(&global_ply(folder.path()), &LocalFrame::WORLD).unwrap().len();
    drones.push(Keeping::new(&network, "far", 10.0));
    let second = fly(&network, &mut ground, &mut drones, 3);
    ask_to_restore(folder.path(), first.0).unwrap();
    let mut events = Vec::new();
    while drones[..2].iter().any(|drone| drone.complete.is_none_or(|complete| complete.revision <= second)) {
        let now = network.now();
        drones.iter_mut().for_each(|drone| drone.step(now));
        step(&network, &mut ground, &mut [], &mut events);
    }
    let all = ply::read(&global_ply(folder.path()), &LocalFrame::WORLD).unwrap();
    assert!(all.len() == before && all.means.iter().all(|mean| mean[0] < 7.0), "the third strip is gone");
    assert_eq!(drones[0].xs().len() + drones[1].xs().len(), before, "each has its ground");
}

#[test]
fn a_drone_that_has_lost_its_folder_gets_all_its_tiles_again() {
    let folder = tempfile::tempdir().unwrap();
    let network = MemoryNetwork::new(50, BAD_WEATHER);
    let mut ground = open_tiled(&network, folder.path());
    let mut drones = vec![Keeping::new(&network, "west", -10.0), Keeping::new(&network, "east", 2.0)];
    let revision = fly(&network, &mut ground, &mut drones, 2);
    let (tiles, xs) = (drones[0].tiles.clone(), drones[0].xs());
    drones.iter_mut().for_each(|drone| drone.tiles.clear());
    let next_life = Identity { session: 2, ..identity("west", Role::Device) };
    let lost = std::mem::replace(&mut drones[0], Keeping::with_an_empty_folder(&network, next_life, -10.0));
    network.leave(lost.transport);
    let mut events = Vec::new();
    let end = network.now() + Duration::from_secs(600);
    while drones[0].complete.is_none() {
        assert!(network.now() < end, "ten minutes later: {} of {} tiles", drones[0].tiles.len(), tiles.len());
        let now = network.now();
        drones.iter_mut().for_each(|drone| drone.step(now));
        step(&network, &mut ground, &mut [], &mut events);
    }
    assert_eq!(drones[0].complete.map(|complete| complete.revision), Some(revision));
    assert_eq!((&drones[0].tiles, drones[0].xs()), (&tiles, xs));
    assert!(drones[1].tiles.is_empty(), "the other drone got tiles too");
    assert_eq!(count(&events, |event| matches!(event, ServiceEvent::LostThere { .. })), 1);
}

/// The manifest and each tile get one damage, and the service starts again. Drones that have nothing yet get the same splats.
#[test]
fn damaged_tiles_are_made_anew() {
    let undamaged = tempfile::tempdir().unwrap();
    let two =
        |network: &MemoryNetwork| [Keeping::new(network, "west", -10.0), Keeping::new(network, "east", 2.0)];
    let network = MemoryNetwork::new(60, Faults::NONE);
    let mut ground = open_tiled(&network, undamaged.path());
    let mut drones = two(&network);
    fly(&network, &mut ground, &mut drones, 2);
    let right = drones.each_ref().map(Keeping::xs);
    drop(ground);
    let mut files = Vec::new();
    list_files(undamaged.path(), &undamaged.path().join("sent"), &mut files);
    assert!(files.len() > SWEPT.len(), "{files:?}");
    for (i, file) in files.iter().enumerate() {
        let (name, damage) = SWEPT[i % SWEPT.len()];
        let folder = tempfile::tempdir().unwrap();
        copy(undamaged.path(), folder.path());
        damage(&folder.path().join(file));
        let network = MemoryNetwork::new(61, Faults::NONE);
        let mut ground = open_tiled(&network, folder.path());
        let (mut drones, mut events) = (two(&network), Vec::new());
        while drones.iter().any(|drone| drone.complete.is_none())
            || !events.contains(&ServiceEvent::Delivered)
        {
            let now = network.now();
            drones.iter_mut().for_each(|drone| drone.step(now));
            step(&network, &mut ground, &mut [], &mut events);
        }
        assert_eq!(count(&events, is_disk_failure), 0, "{}, {name}: {events:?}", file.display());
        assert!(drones.each_ref().map(Keeping::xs) == right, "{}, {name}: other splats", file.display());
    }
}
