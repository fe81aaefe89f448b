//! A cloud over two edges over eight drones, on one thread. Every drone must end with the cloud's splats of its own
//! ground, and with no others.

use std::collections::BTreeSet;
use std::path::PathBuf;

use cosurf_link::{Complete, Credentials, InboxLimits, Manifest, ModelStore, Received};
use cosurf_scene::{LocalFrame, Splats};
use cosurf_tests::dice::Dice;

use super::damage::{SWEPT, list_files};
use super::*;
use crate::service::upstream::{UpstreamEvent, UpstreamNode};
use crate::testing::{QUICK, above, ground};

const MANY_TILES: InboxLimits = InboxLimits { stored_max: 1000, models_max: 8, ..LIMITS };
const SETTINGS: MergeSettings = MergeSettings { seed: 5, ..QUICK };
const DRONES: usize = 8;
/// Each drone sees a strip of this width. Between two strips is as much ground that no drone sees.
const STRIP_M: f32 = 4.0;
/// The longest wait of an edge for the cloud.
const WAIT: Duration = Duration::from_secs(30);
/// Longest virtual time of a run.
const LONG: Duration = Duration::from_secs(900);

/// How the aggregators merge and the cloud sends its model.
#[derive(Clone, Copy, PartialEq)]
enum Size {
    /// The cloud sends tiles.
    Large,
    /// The cloud sends tiles, and no splat is distilled: only the ground of changed models changes.
    LargeUndistilled,
    /// The cloud sends the whole model.
    Small,
}

fn of_edge(drone: usize) -> &'static str {
    if drone < DRONES / 2 { "edge-1" } else { "edge-2" }
}

fn name(drone: usize) -> String {
    format!("drone-{drone}")
}

fn west(drone: usize) -> f32 {
    2.0 * STRIP_M * (drone as f32 - DRONES as f32 / 2.0)
}

/// The model of a drone. Another `version` has other colours.
fn strip(drone: usize, version: u64) -> Model {
    let west = west(drone);
    let mut splats = ground(west, west + STRIP_M);
    // Not on the borders of tiles, which are at fractions with powers of two: the merge moves splats a little.
    splats.means.iter_mut().for_each(|mean| *mean = [mean[0] + 0.13, mean[1] + 0.13, mean[2]]);
    splats.sh.iter_mut().for_each(|value| *value += 0.1 * (version - 1) as f32);
    let cameras = [1.0, 3.0].map(|x| above(f64::from(west) + x).resized([24, 16]));
    Model { splats, cameras: cameras.to_vec() }
}

/// An aggregator, its transport, and for an edge its link to the cloud.
struct Level {
    service: Service,
    transport: MemoryTransport,
    above: Option<(UpstreamNode, MemoryTransport)>,
    /// Revisions that the service made.
    merged: BTreeSet<ModelId>,
}

impl Level {
    fn open(network: &MemoryNetwork, folder: &Path, site: &str, below: &[String], size: Size) -> Self {
        // As in the field, sessions have far higher numbers than revisions.
        let session = 1_800_000_000;
        let ground = Identity { session, ..testing::identity(site, "aggregator", Role::Aggregator) };
        let mut service = Service::open(ServiceConfig {
            identity: ground,
            folder: folder.join(site),
            limits: MANY_TILES,
            expected: Expected::Devices(below.iter().map(|name| DeviceId::new(name).unwrap()).collect()),
            merge: MergeSettings { epochs: u32::from(size != Size::LargeUndistilled), ..SETTINGS },
            threads: 1,
        })
        .unwrap();
        if size != Size::Small && site == "cloud" {
            service.keeper.work.whole_splats_max = 100;
        }
        let mut above = None;
        if site != "cloud" {
            let device = testing::identity("cloud", site, Role::Device);
            let (node, link) =
                UpstreamNode::open(device, Credentials::default(), &folder.join(site), MANY_TILES).unwrap();
            service = service.below(link, WAIT);
            above = Some((node, network.join(&device)));
        }
        Self { service, transport: network.join(&ground), above, merged: BTreeSet::new() }
    }

    fn step(&mut self, now: Duration) {
        let mut revision = None;
        let _ = self.service.step(
            &mut self.transport,
            || now,
            Duration::ZERO,
            |event| {
                if let ServiceEvent::Merged { header, .. } = event {
                    revision = Some(header);
                }
                assert!(!is_disk_failure(&event), "{event:?}");
                ControlFlow::Continue(())
            },
        );
        self.merged.extend(revision.map(|header| header.model));
        let Some((node, transport)) = &mut self.above else { return };
        if let Some(revision) = revision {
            node.send(&revision).unwrap();
        }
        let event = node.step(transport, || now, Duration::ZERO);
        let is_failure = |event: &UpstreamEvent| match event {
            UpstreamEvent::UpstreamDiskFailed { reason } => !reason.contains("it is set aside"),
            _ => false,
        };
        assert!(!event.as_ref().is_some_and(is_failure), "{event:?}");
    }
}

/// A drone that sends its model and keeps what it receives on disk.
struct Agent {
    number: usize,
    node: Node,
    transport: MemoryTransport,
    folder: PathBuf,
    received: Received,
    complete: Option<Complete>,
    /// The tiles that arrived in this life.
    tiles: BTreeSet<ModelKey>,
}

impl Agent {
    fn new(network: &MemoryNetwork, folder: &Path, number: usize, version: u64) -> Self {
        let (name, folder) = (name(number), folder.join(name(number)));
        let identity = testing::identity(of_edge(number), &name, Role::Device);
        let (received, known) =
            Received::open(identity.device, &folder.join("global"), folder.join("global.ply")).unwrap();
        let mut node = Node::new(identity, MANY_TILES, &known);
        let Model { splats, cameras } = strip(number, version);
        let offer =
            Offer::new(identity.device, ModelId(version), ModelKind::Local, 2, &splats, &cameras).unwrap();
        node.upload(offer);
        let transport = network.join(&identity);
        Self { number, node, transport, folder, received, complete: None, tiles: BTreeSet::new() }
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
        if let (Some(old), Some(new)) = (self.complete, complete) {
            assert!(old.revision <= new.revision, "{} got an older model", name(self.number));
        }
        self.complete = complete.or(self.complete);
    }

    fn splats(&self) -> BTreeSet<Vec<u32>> {
        self.complete
            .map(|_| bits(&ply::read(&self.folder.join("global.ply"), &LocalFrame::WORLD).unwrap()))
            .unwrap_or_default()
    }
}

/// Each splat's mean, colour and opacity, bit by bit.
fn bits(splats: &Splats) -> BTreeSet<Vec<u32>> {
    let stride = splats.sh_stride();
    let of = |i: usize| {
        let floats = splats.means[i].iter().chain(&splats.sh[i * stride..(i + 1) * stride]);
        floats.chain([&splats.opacity_logits[i]]).map(|value| value.to_bits()).collect()
    };
    (0..splats.len()).map(of).collect()
}

/// The splats of the cloud's newest model as its devices get them: of the ground of one drone, or all.
fn of_cloud(folder: &Path, drone: Option<usize>) -> BTreeSet<Vec<u32>> {
    let newest = |name: &str| {
        let (store, headers) = ModelStore::open(&folder.join("cloud").join(name)).ok()?;
        let newest = headers.into_iter().filter(|header| !header.model.is_tile());
        Some((store, newest.max_by_key(|header| header.model)?))
    };
    let splats = |store: &ModelStore, key: ModelKey| {
        bits(&body_to_model(&store.get(key).unwrap().1, &LocalFrame::WORLD).unwrap().splats)
    };
    let mut all = BTreeSet::new();
    if let Some((store, header)) = newest("sent") {
        let manifest = Manifest::decode(&store.get(header.into()).unwrap().1).unwrap();
        let key = |model| ModelKey { device: header.device, model };
        manifest.tiles.iter().for_each(|tile| all.extend(splats(&store, key(tile.model))));
    } else if let Some((store, header)) = newest("global") {
        all.extend(splats(&store, header.into()));
    }
    let is_its = |splat: &Vec<u32>| {
        let x = f32::from_bits(splat[0]);
        drone.is_none_or(|drone| (-0.5 * STRIP_M..1.5 * STRIP_M).contains(&(x - west(drone))))
    };
    all.into_iter().filter(is_its).collect()
}

/// The aggregators and drones, until they are killed.
struct Site {
    network: MemoryNetwork,
    folder: PathBuf,
    /// The cloud, if it runs, and the edges.
    levels: Vec<Level>,
    agents: Vec<Agent>,
}

impl Site {
    /// `versions` has the number of the model that each drone sends.
    fn open(seed: u64, folder: &Path, has_cloud: bool, size: Size, versions: [u64; DRONES]) -> Self {
        let network = MemoryNetwork::new(seed, BAD_WEATHER);
        let edges = ["edge-1", "edge-2"];
        let below = |edge: &str| (0..DRONES).filter(|i| of_edge(*i) == edge).map(name).collect::<Vec<_>>();
        let mut levels: Vec<Level> =
            edges.iter().map(|edge| Level::open(&network, folder, edge, &below(edge), size)).collect();
        if has_cloud {
            levels.push(Level::open(&network, folder, "cloud", &edges.map(String::from), size));
        }
        let agents =
            versions.iter().enumerate().map(|(i, version)| Agent::new(&network, folder, i, *version));
        let agents = agents.collect();
        Self { network, folder: folder.into(), levels, agents }
    }

    fn step(&mut self) {
        let now = self.network.now();
        self.agents.iter_mut().for_each(|agent| agent.step(now));
        self.levels.iter_mut().for_each(|level| level.step(now));
        match self.levels.iter().any(|level| level.service.is_merging()) {
            true => std::thread::sleep(Duration::from_micros(200)),
            false => self.network.advance(now + Duration::from_millis(5)),
        }
    }

    fn run_until(&mut self, what: &str, mut is_over: impl FnMut(&Self) -> bool) {
        while !is_over(self) {
            assert!(self.network.now() < LONG, "{what}: {}", self.state());
            self.step();
        }
    }

    /// What each drone has, for messages.
    fn state(&self) -> String {
        let of = |agent: &Agent| {
            let (has, cloud) = (agent.splats(), of_cloud(&self.folder, Some(agent.number)));
            let common = has.intersection(&cloud).count();
            let Agent { number, complete, .. } = agent;
            format!(
                "drone {number} has {} splats, {common} of the cloud's {}: {complete:?}",
                has.len(),
                cloud.len()
            )
        };
        self.agents.iter().map(of).collect::<Vec<_>>().join("\n")
    }

    fn is_quiet(&self) -> bool {
        self.levels.iter().all(|level| !level.service.is_merging())
    }

    /// Whether every drone has exactly the cloud's splats of its ground.
    fn all_have_the_clouds(&self, size: Size) -> bool {
        let expected = |agent: &Agent| {
            let drone = (size != Size::Small).then_some(agent.number);
            of_cloud(&self.folder, drone)
        };
        self.agents.iter().all(|agent| agent.complete.is_some() && agent.splats() == expected(agent))
    }

    /// Runs until the cloud's model is as it should be, and every drone has exactly the cloud's splats of its ground. Checks
    /// that it stays so.
    fn run_until_all_have_the_clouds(&mut self, size: Size, is_ready: impl Fn(&Path) -> bool) {
        let mut next_look = Duration::ZERO;
        self.run_until("not all drones got the cloud's model", |site| {
            if site.network.now() < next_look || !site.is_quiet() {
                return false;
            }
            next_look = site.network.now() + Duration::from_secs(1);
            is_ready(&site.folder) && site.all_have_the_clouds(size)
        });
        let until = self.network.now() + WAIT;
        self.run_until("time stands still", |site| site.network.now() >= until);
        assert!(self.all_have_the_clouds(size), "a drone got something else afterwards");
    }
}

const FIRST: [u64; DRONES] = [1; DRONES];

fn shows_all(folder: &Path) -> bool {
    (0..DRONES).all(|drone| !of_cloud(folder, Some(drone)).is_empty())
}

/// Number of tiles that an edge has from the cloud.
fn held(folder: &Path, edge: &str) -> usize {
    let (_, headers) = ModelStore::open(&folder.join(edge).join("upstream/global")).unwrap();
    headers.iter().filter(|header| header.model.is_tile()).count()
}

#[test]
fn every_drone_ends_with_the_clouds_tiles_of_its_ground() {
    let folder = tempfile::tempdir().unwrap();
    let mut site = Site::open(60, folder.path(), true, Size::Large, FIRST);
    site.run_until_all_have_the_clouds(Size::Large, shows_all);
    let all = of_cloud(folder.path(), None).len();
    for agent in &site.agents {
        assert!(agent.splats().len() < all / 4);
        assert!(
            agent.tiles.len() < held(folder.path(), of_edge(agent.number)) / 2,
            "few of its edge's tiles"
        );
    }
}

#[test]
fn drones_get_of_the_clouds_next_model_only_what_has_changed() {
    let folder = tempfile::tempdir().unwrap();
    let mut site = Site::open(61, folder.path(), true, Size::LargeUndistilled, FIRST);
    site.run_until_all_have_the_clouds(Size::LargeUndistilled, shows_all);
    // All are killed. Then a drone of the second edge has another model.
    drop(site);
    let [changed, same] = [6, 1].map(|drone| of_cloud(folder.path(), Some(drone)));
    let mut versions = FIRST;
    versions[6] = 2;
    let mut site = Site::open(62, folder.path(), true, Size::LargeUndistilled, versions);
    site.run_until_all_have_the_clouds(Size::LargeUndistilled, |folder| {
        shows_all(folder) && of_cloud(folder, Some(6)) != changed
    });
    assert!(!site.agents[6].tiles.is_empty());
    assert!(of_cloud(folder.path(), Some(1)) == same, "the merge leaves ground far away as it was");
    assert!(site.agents[1].tiles.is_empty(), "what has not changed is not sent again");
}

#[test]
fn every_drone_ends_with_the_whole_model_of_the_cloud_if_it_is_small() {
    let folder = tempfile::tempdir().unwrap();
    let mut site = Site::open(62, folder.path(), true, Size::Small, FIRST);
    site.run_until_all_have_the_clouds(Size::Small, shows_all);
}

#[test]
fn without_the_cloud_the_drones_get_the_edges_model_and_later_the_clouds() {
    let folder = tempfile::tempdir().unwrap();
    let mut site = Site::open(63, folder.path(), false, Size::Large, FIRST);
    site.run_until("the drones got no model", |site| {
        site.agents.iter().all(|agent| agent.complete.is_some())
    });
    assert!(site.network.now() >= WAIT, "the edges waited for the cloud");
    for agent in &site.agents {
        let edge =
            ply::read(&global_ply(&folder.path().join(of_edge(agent.number))), &LocalFrame::WORLD).unwrap();
        assert_eq!(agent.splats().len(), edge.len());
    }
    drop(site);
    let mut site = Site::open(64, folder.path(), true, Size::Large, FIRST);
    site.run_until_all_have_the_clouds(Size::Large, shows_all);
}

#[test]
fn every_drone_ends_with_the_clouds_tiles_although_all_are_killed_again_and_again() {
    for seed in 0..4 {
        let folder = tempfile::tempdir().unwrap();
        let mut dice = Dice(seed);
        for life in 0..5 {
            let mut site = Site::open(70 + 10 * seed + life, folder.path(), true, Size::Large, FIRST);
            let until = Duration::from_millis(1 + dice.below(8000) as u64);
            site.run_until("time stands still", |site| site.network.now() >= until);
        }
        let mut site = Site::open(170 + seed, folder.path(), true, Size::Large, FIRST);
        site.run_until_all_have_the_clouds(Size::Large, shows_all);
    }
}

/// Everything is stopped, several files of the cloud, the edges and the drones are damaged, and everything starts again.
#[test]
fn every_drone_ends_with_the_clouds_tiles_although_files_of_all_kinds_are_damaged() {
    let folder = tempfile::tempdir().unwrap();
    let mut dice = Dice(9);
    for life in 0..5 {
        let mut site = Site::open(300 + life, folder.path(), true, Size::Large, FIRST);
        site.run_until_all_have_the_clouds(Size::Large, shows_all);
        drop(site);
        let mut damaged = Vec::new();
        for of in ["cloud", "edge-1", "edge-2", "drone-0", "drone-7"] {
            let mut files = Vec::new();
            list_files(folder.path(), &folder.path().join(of), &mut files);
            // Links that lead nowhere were set aside in an earlier life.
            files.retain(|file| folder.path().join(file).is_file());
            // Of each kind of file, that is of each folder, one at most.
            files.sort_by_cached_key(|_| dice.below(1 << 30));
            let mut kinds = BTreeSet::new();
            files.retain(|file| kinds.insert(file.parent().map(Path::to_owned)));
            damaged.extend(files.into_iter().map(|file| (file, SWEPT[dice.below(SWEPT.len())])));
        }
        for (file, (name, damage)) in damaged {
            println!("life {life}: {}: {name}", file.display());
            damage(&folder.path().join(file));
        }
    }
}
