//! An honest participant: its node, its connection, and its disk.

use std::collections::BTreeMap;
use std::time::Duration;

use cosurf_link::{
    Complete, Credentials, Identity, InboxLimits, MemoryNetwork, ModelKey, Node, NodeEvent, Offer, Received,
    Role, Transport,
};
use cosurf_scene::Camera;
use cosurf_wire::{BodyHash, DeviceId, MAX_CONTROL_BYTES, ModelHeader};

use super::cast::{device, drone, planned};
use super::judge::{Invariant, Judge, Verdict, demand};
use super::metered::{Metered, Traffic};
use super::plan::Plan;
use crate::memory::allocated_bytes;

/// A way in which a participant is broken on purpose, to see that an invariant can fail.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Flaw {
    /// Believes everybody, though the site has keys.
    Trusting,
    /// Acknowledges models that it does not store.
    Forgetful,
    /// Takes 16 times as much memory as it should.
    Greedy,
    /// Says everything many times.
    Talkative,
    /// Hears and says nothing after it has connected.
    Mute,
}

/// An honest participant.
pub(crate) struct Member {
    pub(crate) identity: Identity,
    pub(crate) node: Node,
    pub(crate) transport: Metered,
    credentials: Option<Credentials>,
    limits: InboxLimits,
    devices_max: usize,
    flaw: Option<Flaw>,
    /// What a restart leaves: the headers of stored models.
    disk: BTreeMap<ModelKey, ModelHeader>,
    /// The folder of a device that receives tiles.
    tiles: Option<(tempfile::TempDir, Received)>,
    /// The revisions that the folder has completed.
    pub(crate) complete: Option<Complete>,
    /// Models that are offered to the other side again after a restart.
    pub(crate) offers: Vec<Offer>,
    pub(crate) flight: Vec<Camera>,
    /// Of an aggregator: the flights that were pledged to this session.
    pledged: BTreeMap<DeviceId, BodyHash>,
    pub(crate) failing_writes: u32,
    /// Start of the session.
    begun: Duration,
    /// Memory of the node, bytes: now, and at most.
    heap_bytes: isize,
    pub(crate) heap_share: f64,
    /// Bytes that the bodies of the node's own offers take, and their chunks.
    offered: (usize, u64),
}

impl Member {
    pub(crate) fn new(network: &MemoryNetwork, identity: Identity, plan: &Plan, flaw: Option<Flaw>) -> Self {
        let mut member = Self {
            identity,
            node: Node::new(identity, plan.limits, &[]),
            transport: Metered::new(network.join(&identity)),
            credentials: None,
            limits: plan.limits,
            devices_max: plan.devices_max,
            flaw,
            disk: BTreeMap::new(),
            tiles: None,
            complete: None,
            offers: Vec::new(),
            flight: Vec::new(),
            pledged: BTreeMap::new(),
            failing_writes: 0,
            begun: network.now(),
            heap_bytes: 0,
            heap_share: 0.0,
            offered: (0, 0),
        };
        if plan.has_tiles && identity.role == Role::Device {
            member.open_tiles(tempfile::tempdir_in(shared_memory()).unwrap());
        }
        member.begin();
        member
    }

    /// Gives the participant its keys, before it has said anything.
    pub(crate) fn set_credentials(&mut self, credentials: Credentials) {
        self.credentials = Some(credentials);
        self.begin();
    }

    fn open_tiles(&mut self, folder: tempfile::TempDir) {
        let ply = folder.path().join("global.ply");
        let (received, headers) =
            Received::open(self.identity.device, &folder.path().join("global"), ply).unwrap();
        self.disk = headers.iter().map(|header| (ModelKey::from(header), *header)).collect();
        self.tiles = Some((folder, received));
    }

    /// Begins a session.
    fn begin(&mut self) {
        let headers: Vec<ModelHeader> = self.disk.values().copied().collect();
        let mut limits = self.limits;
        if self.flaw == Some(Flaw::Greedy) {
            limits.total_bytes_max *= 16;
            limits.models_max *= 16;
        }
        self.node = Node::new(self.identity, limits, &[]);
        let before = allocated_bytes();
        self.node = Node::new(self.identity, limits, &headers);
        self.node.set_devices_max(self.devices_max);
        if let Some(mut credentials) = self.credentials.clone() {
            if self.flaw == Some(Flaw::Trusting) {
                (credentials.trusted, credentials.fleet) = (None, None);
            }
            self.node.set_credentials(credentials);
        }
        if !self.flight.is_empty() {
            self.node.announce_flight(&self.flight);
        }
        match self.identity.role {
            Role::Device => self.node.ask_for_plan(),
            Role::Aggregator => {
                let drones = (1..9).map(|index| device(&drone(index)));
                let cells = drones.filter_map(|device| Some((device, planned(device)?)));
                self.node.share_plan(cells.collect());
            }
        }
        self.heap_bytes = allocated_bytes() - before;
        self.offered = (0, 0);
        self.pledged.clear();
        self.transport.copies = if self.flaw == Some(Flaw::Talkative) { 40 } else { 1 };
    }

    /// Simulates a crash and a restart: the participant keeps nothing but its disk.
    pub(crate) fn restart(&mut self, network: &MemoryNetwork, judge: &mut Judge) -> Verdict {
        self.check_traffic(network.now(), judge)?;
        self.identity.session += 1;
        judge.note_session(self.identity.device, self.identity.session);
        if let Some((folder, _)) = self.tiles.take() {
            self.open_tiles(folder);
        }
        self.end();
        let joined = Metered::new(network.join(&self.identity));
        network.leave(std::mem::replace(&mut self.transport, joined).inner);
        self.begun = network.now();
        self.begin();
        Ok(())
    }

    /// Frees the node. All that it has allocated must be freed with it, or its memory was measured wrongly.
    pub(crate) fn end(&mut self) {
        let before = allocated_bytes();
        let empty = Node::new(self.identity, self.limits, &[]);
        let node = std::mem::replace(&mut self.node, empty);
        drop(node);
        self.heap_bytes += allocated_bytes() - before;
        if self.tiles.is_none() {
            let own = self.identity.device;
            assert_eq!(self.heap_bytes, 0, "{own}: the memory of the node was not measured");
        }
    }

    /// Gives a model to the node, which offers it by `offer`. The model is offered again after restarts.
    pub(crate) fn offer(&mut self, model: Offer, offer: impl FnOnce(&mut Node, Offer)) {
        self.offered.0 += model.body.capacity();
        self.offered.1 += u64::from(model.header.chunks());
        self.heap_bytes += model.body.capacity() as isize;
        let before = allocated_bytes();
        offer(&mut self.node, model);
        self.heap_bytes += allocated_bytes() - before;
    }

    pub(crate) fn announce_flight(&mut self, cameras: Vec<Camera>, judge: &mut Judge) {
        judge.note_flight(self.identity.device, &cameras);
        let before = allocated_bytes();
        self.node.announce_flight(&cameras);
        self.heap_bytes += allocated_bytes() - before;
        self.flight = cameras;
    }

    /// Steps the node until nothing is due.
    pub(crate) fn work(&mut self, now: Duration, judge: &mut Judge) -> Verdict {
        if self.flaw == Some(Flaw::Mute) && now > self.begun {
            while self.transport.inner.poll(Duration::ZERO).is_some() {}
            return Ok(());
        }
        let mut idle = 0;
        while idle < 2 {
            let before = allocated_bytes();
            let event = self.node.step(&mut self.transport, || now, Duration::ZERO);
            self.heap_bytes += allocated_bytes() - before - self.transport.take_foreign_bytes();
            match event {
                Some(event) => {
                    idle = 0;
                    judge.hear(&self.identity, &event)?;
                    self.take(event, judge);
                }
                None => idle += 1,
            }
            self.check_memory()?;
        }
        Ok(())
    }

    fn take(&mut self, event: NodeEvent, judge: &mut Judge) {
        let (site, own) = (self.identity.site, self.identity.device);
        if let NodeEvent::Store { header, .. } = &event
            && self.failing_writes > 0
        {
            self.failing_writes -= 1;
            self.metered(|node| node.store_failed(header.into()));
        } else if let NodeEvent::Store { header, body } = &event {
            let key = ModelKey::from(header);
            if self.flaw != Some(Flaw::Forgetful) {
                self.disk.insert(key, *header);
                judge.note_stored(site, own, key);
            }
            let body = body.to_vec();
            self.keep(*header, Some(&body));
        } else if let NodeEvent::Known(header) = &event {
            self.keep(*header, None);
        } else if let NodeEvent::FlightPledged { device, cameras_blake3, .. } = &event {
            self.pledged.insert(*device, *cameras_blake3);
            let flights: Vec<_> = self.pledged.iter().map(|(device, hash)| (*device, *hash)).collect();
            let before = allocated_bytes();
            self.node.confirm_flights(flights.clone());
            self.heap_bytes += allocated_bytes() - before;
        }
        let before = allocated_bytes();
        drop(event);
        self.heap_bytes += allocated_bytes() - before;
    }

    /// Tells the node that a model is stored, by way of the folder of tiles if there is one.
    fn keep(&mut self, header: ModelHeader, body: Option<&[u8]>) {
        let complete = match (&mut self.tiles, body) {
            (None, None) => return,
            (None, Some(_)) => return self.metered(|node| node.stored(header.into())),
            (Some((_, received)), Some(body)) => received.take(&mut self.node, header, body).unwrap(),
            (Some((_, received)), None) => received.known(&mut self.node, header).unwrap(),
        };
        self.complete = complete.or(self.complete);
    }

    fn metered(&mut self, change: impl FnOnce(&mut Node)) {
        let before = allocated_bytes();
        change(&mut self.node);
        self.heap_bytes += allocated_bytes() - before;
    }

    /// The memory of the node is within what its limits allow.
    fn check_memory(&mut self) -> Verdict {
        let unfinished = self.node.unfinished_bytes();
        demand(unfinished <= self.limits.total_bytes_max, Invariant::Memory, || {
            format!("{}: bodies of {unfinished} bytes: {:?}", self.identity.device, self.limits)
        })?;
        if self.tiles.is_some() {
            // The folder of tiles allocates, too, so the node's own share is not known.
            return Ok(());
        }
        let allowed = self.heap_bytes_max();
        self.heap_share = self.heap_share.max(self.heap_bytes as f64 / allowed as f64);
        demand(self.heap_bytes <= allowed, Invariant::Memory, || {
            format!("{} takes {} bytes of {allowed}", self.identity.device, self.heap_bytes)
        })
    }

    /// Memory that a node may take, bytes: bodies, its own offers, and what it remembers of others.
    fn heap_bytes_max(&self) -> isize {
        let InboxLimits { total_bytes_max, models_max, stored_max, .. } = self.limits;
        let replies = 256 * 2 * MAX_CONTROL_BYTES;
        let peers = (1 + self.offers.len()) * (self.devices_max + 4) * 2048;
        let others = models_max * 2048 + (stored_max + self.disk.len()) * 512 + self.devices_max * 512;
        (total_bytes_max as usize + self.offered.0 + replies + peers + others + (32 << 10)) as isize
    }

    /// What the participant has sent is in proportion to what it has received, and to the time.
    pub(crate) fn check_traffic(&self, now: Duration, judge: &Judge) -> Verdict {
        let Traffic { received, told, chunks, answered } = &self.transport.traffic;
        let (own, seconds) = (self.identity.device, (now - self.begun).as_secs());
        let stranger = answered.iter().find(|device| !judge.may_be_answered(device));
        demand(stranger.is_none(), Invariant::Replies, || format!("{own} answers {stranger:?}"))?;
        // Each transfer asks at most twice a second by itself, and each offer is announced every two seconds.
        let own_pace = (2 * self.limits.models_max as u64 + self.offers.len() as u64 + 1) * (seconds + 2);
        demand(*told <= received + own_pace + 20, Invariant::Replies, || {
            format!("{own} says {told} messages in {seconds} s, after {received} from others")
        })?;
        for (key, sent) in chunks {
            let offer = self.offers.iter().find(|offer| ModelKey::from(offer.header) == *key);
            let Some(of) = offer.map(|offer| u64::from(offer.header.chunks())) else { continue };
            // Each receiver may get the body, two resends for each chunk, and a body's worth every 30 s.
            let peers = if self.identity.role == Role::Device { 1 } else { self.devices_max as u64 + 4 };
            let most = peers * (3 * of + of.max(32) * (2 + seconds / 30));
            demand(*sent <= most, Invariant::Replies, || {
                format!("{own} sends {sent} chunks of {key}, which has {of}, in {seconds} s; at most {most}")
            })?;
        }
        Ok(())
    }

    /// When the node is next due.
    pub(crate) fn next_wakeup(&self) -> Option<Duration> {
        self.node.next_wakeup().filter(|_| self.flaw != Some(Flaw::Mute))
    }
}

/// A folder in memory, if the system has one.
fn shared_memory() -> &'static std::path::Path {
    let shared = std::path::Path::new("/dev/shm");
    if shared.is_dir() { shared } else { std::path::Path::new("/tmp") }
}
