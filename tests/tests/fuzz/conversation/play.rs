//! One conversation from its seed to its end.

use std::time::Duration;

use cosurf_link::{Identity, MemoryNetwork, ModelKey, Offer, Role};
use cosurf_tests::dice::Dice;
use cosurf_tests::models::cameras;
use cosurf_wire::{DeviceId, ModelId, ModelKind, TileId};

use super::cast::{CLOUD, FAR_DRONE, GROUND, INSIDER, credentials, device, drone, model, site, tiles};
use super::hostile::Hostile;
use super::judge::{Invariant, Judge, Verdict, Violation, demand};
use super::member::{Flaw, Member};
use super::plan::{Mode, Plan};

/// Simulated time after the end of the attack in which all honest models arrive.
const PATIENCE: Duration = Duration::from_secs(300);
/// Shortest step of simulated time.
const STEP: Duration = Duration::from_millis(4);

/// Figures of a conversation that has ended well.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Figures {
    /// Simulated time after the end of the attack until all honest models had arrived.
    pub(crate) late: Duration,
    /// Hostile messages.
    pub(crate) hostile: u64,
    /// Messages that participants have received.
    pub(crate) received: u64,
    /// The largest share that a participant took of the memory that it may take.
    pub(crate) heap_share: f64,
}

/// A flaw of the participant with this index.
pub(crate) type Broken = Option<(usize, Flaw)>;

/// A conversation.
struct Play {
    plan: Plan,
    network: MemoryNetwork,
    /// The aggregator of the lower site, its drones and, if there is a site above, the same aggregator as a device there,
    /// the aggregator there, and its drone.
    members: Vec<Member>,
    hostile: Hostile,
    judge: Judge,
    dice: Dice,
    /// Models that drones have still to offer: when, who, and what.
    flights: Vec<(Duration, usize, Offer)>,
    /// When the next trouble comes, and how many are left.
    trouble: (Duration, usize),
    is_broker_down: bool,
    /// Tiles that the aggregator has still to send.
    tiles: Vec<(DeviceId, Offer)>,
}

/// Holds the conversation of a seed.
pub(crate) fn play(seed: u64, broken: Broken) -> Result<Figures, Violation> {
    let mut play = Play::new(seed, broken);
    let outcome = play.run();
    if outcome.is_ok() {
        play.members.iter_mut().for_each(Member::end);
    }
    outcome
}

impl Play {
    fn new(seed: u64, broken: Broken) -> Self {
        let mut dice = Dice(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ 0xC0_5F);
        let plan = Plan::of(&mut dice);
        let network = MemoryNetwork::new(seed, plan.faults);
        let hostile = Hostile::new(&network, &plan, Dice(dice.bits()));
        let mut play = Self {
            judge: Judge::new(plan.mode),
            trouble: (Duration::from_millis(dice.below(4000) as u64), plan.troubles),
            plan,
            network,
            members: Vec::new(),
            hostile,
            dice,
            flights: Vec::new(),
            is_broker_down: false,
            tiles: Vec::new(),
        };
        play.join_all(broken);
        play
    }

    /// Lets all honest participants join, and decides when the drones have models.
    fn join_all(&mut self, broken: Broken) {
        let drones: Vec<String> = (0..self.plan.drones).map(|i| drone(1 + i)).collect();
        let drones: Vec<&str> = drones.iter().map(String::as_str).collect();
        self.join(0, Role::Aggregator, GROUND, &drones, broken);
        for name in &drones {
            self.join_drone(0, name, &[GROUND], &drones, broken);
        }
        if self.plan.has_cloud {
            self.join(1, Role::Device, GROUND, &[CLOUD], broken);
            self.join(1, Role::Aggregator, CLOUD, &[GROUND, FAR_DRONE], broken);
            self.join_drone(1, FAR_DRONE, &[CLOUD], &[FAR_DRONE], broken);
        }
    }

    fn join_drone(&mut self, at: usize, name: &str, trusted: &[&str], fleet: &[&str], broken: Broken) {
        self.join(at, Role::Device, name, trusted, broken);
        let index = self.members.len() - 1;
        if self.plan.mode == Mode::Signed {
            let mut fleet = fleet.to_vec();
            fleet.extend(self.plan.has_insider.then_some(INSIDER));
            self.members[index].set_credentials(credentials(name, trusted, Some(&fleet)));
        }
        if self.dice.coin() {
            self.members[index].announce_flight(cameras(1 + self.dice.below(3)), &mut self.judge);
        }
        let mut at = Duration::from_millis(self.dice.below(4000) as u64);
        for number in 1..2 + u64::from(self.dice.below(3) == 0) {
            let seed = self.dice.bits();
            let of = self.members[index].identity.device;
            let offer = model(of, ModelId(number), ModelKind::Local, seed, self.plan.chunk_bytes);
            self.flights.push((at, index, offer));
            at += Duration::from_millis(self.dice.below(15_000) as u64);
        }
    }

    fn join(&mut self, at: usize, role: Role, name: &str, trusted: &[&str], broken: Broken) {
        let session = 1000 + self.dice.below(3) as u64;
        let identity = Identity { site: site(at), device: device(name), session, role };
        let flaw = broken.filter(|(index, _)| *index == self.members.len()).map(|(_, flaw)| flaw);
        self.judge.note_session(identity.device, session);
        let mut member = Member::new(&self.network, identity, &self.plan, flaw);
        if self.plan.mode == Mode::Signed {
            let mut trusted = trusted.to_vec();
            trusted.extend((self.plan.has_insider && role == Role::Aggregator).then_some(INSIDER));
            member.set_credentials(credentials(name, &trusted, None));
        }
        self.members.push(member);
    }

    fn run(&mut self) -> Result<Figures, Violation> {
        loop {
            let now = self.network.now();
            self.hostile.work(now);
            for member in &mut self.members {
                member.work(now, &mut self.judge)?;
            }
            self.offer_all(now)?;
            self.strike(now)?;
            if self.hostile.is_over(now) && self.is_done() {
                break;
            }
            demand(now < self.plan.attack + PATIENCE, Invariant::Progress, || self.describe())?;
            self.pass(now);
        }
        let now = self.network.now();
        self.members.iter().try_for_each(|member| member.check_traffic(now, &self.judge))?;
        Ok(Figures {
            late: now.saturating_sub(self.plan.attack),
            hostile: self.hostile.said,
            received: self.members.iter().map(|member| member.transport.traffic.received).sum(),
            heap_share: self.members.iter().map(|member| member.heap_share).fold(0.0, f64::max),
        })
    }

    /// Lets time pass until something is due.
    fn pass(&mut self, now: Duration) {
        let wakeups = self.members.iter().filter_map(Member::next_wakeup).chain(self.hostile.next_wakeup());
        let flights = self.flights.iter().map(|(at, ..)| *at).filter(|at| *at > now);
        let trouble = (self.trouble.1 > 0 || self.is_broker_down).then_some(self.trouble.0);
        let next = wakeups.chain(flights).chain(trouble).min().unwrap_or(Duration::MAX);
        self.network.advance(next.clamp(now + STEP, now + Duration::from_secs(2)));
    }

    /// Whether all honest senders were told that their models are stored. Where strangers may say so, too, nobody counts
    /// on it.
    fn is_done(&self) -> bool {
        let has_global = self.judge.untold().next().is_none() && self.flights.is_empty() && self.is_sent(0);
        has_global || self.plan.mode == Mode::Open
    }

    fn describe(&self) -> String {
        let untold: Vec<String> = self.judge.untold().map(|(site, key)| format!("{key} at {site}")).collect();
        let unfinished: Vec<String> = self
            .members
            .iter()
            .flat_map(|member| {
                member.node.unfinished().map(|header| format!("{}: {header:?}", member.identity.device))
            })
            .collect();
        format!("{untold:?} are not stored in time; unfinished: {unfinished:#?}; {:?}", self.plan)
    }

    /// Whether the aggregator with this index has offered a global model.
    fn is_sent(&self, index: usize) -> bool {
        self.members[index].offers.iter().any(|offer| offer.header.kind != ModelKind::Local)
    }

    /// Gives the participants what they have to offer by now.
    fn offer_all(&mut self, now: Duration) -> Verdict {
        let due: Vec<usize> = (0..self.flights.len()).filter(|i| self.is_due(now, *i)).rev().collect();
        for i in due {
            let (_, index, offer) = self.flights.remove(i);
            self.upload(index, offer);
        }
        let (drones, above) = (self.plan.drones, 1 + self.plan.drones);
        if !self.plan.has_cloud {
            if !self.is_sent(0) && self.has_all(0, 1..1 + drones) {
                let seed = self.dice.bits();
                self.broadcast(0, 1..1 + drones, seed);
            }
        } else {
            self.relay(drones, above);
        }
        self.send_tiles();
        Ok(())
    }

    /// Whether it is time for a flight: drones offer one model after the other.
    fn is_due(&self, now: Duration, flight: usize) -> bool {
        let (at, index, offer) = &self.flights[flight];
        let site = self.members[*index].identity.site;
        let before = ModelKey { model: ModelId(offer.header.model.0 - 1), ..ModelKey::from(offer.header) };
        *at <= now && (before.model.0 == 0 || self.judge.is_told(site, before))
    }

    /// The aggregator of the lower site sends its model up, and the model from above down.
    fn relay(&mut self, drones: usize, above: usize) {
        let (cloud, far) = (above + 1, above + 2);
        if self.members[above].offers.is_empty() && self.has_all(0, 1..1 + drones) {
            let (of, seed) = (self.members[above].identity.device, self.dice.bits());
            self.upload(above, model(of, ModelId(1), ModelKind::Local, seed, self.plan.chunk_bytes));
        }
        let has_both = !self.members[above].offers.is_empty()
            && self.has_all(cloud, above..above + 1)
            && self.has_all(cloud, far..far + 1);
        if !self.is_sent(cloud) && has_both {
            let seed = self.dice.bits();
            self.broadcast(cloud, [above, far], seed);
        }
        let global = self.members[cloud].offers.first().map(|offer| ModelKey::from(offer.header));
        let has_global =
            global.is_some_and(|key| self.judge.is_held(site(1), self.members[above].identity.device, key));
        if !self.is_sent(0) && has_global {
            let seed = self.dice.bits();
            self.broadcast(0, 1..1 + drones, seed);
        }
    }

    /// Whether an aggregator holds the first models of these participants.
    fn has_all(&self, aggregator: usize, mut of: impl Iterator<Item = usize>) -> bool {
        let Identity { site, device: by, .. } = self.members[aggregator].identity;
        of.all(|index| {
            let key = ModelKey { device: self.members[index].identity.device, model: ModelId(1) };
            self.judge.is_held(site, by, key)
        })
    }

    fn upload(&mut self, index: usize, offer: Offer) {
        let site = self.members[index].identity.site;
        let is_aggregator =
            |member: &&Member| member.identity.site == site && member.identity.role == Role::Aggregator;
        let aggregator = self.members.iter().find(is_aggregator).map(|member| member.identity.device);
        let receivers: Vec<DeviceId> = aggregator.into_iter().collect();
        self.judge.note_offer(site, Role::Aggregator, &offer, &receivers);
        self.members[index].offers.push(offer.clone());
        self.members[index].offer(offer, |node, offer| node.upload(offer));
    }

    /// An aggregator sends a global model to these participants.
    fn broadcast(&mut self, index: usize, to: impl IntoIterator<Item = usize>, seed: u64) {
        let receivers: Vec<DeviceId> = to.into_iter().map(|i| self.members[i].identity.device).collect();
        let of = self.members[index].identity;
        let offer = if self.plan.has_tiles {
            let (manifest, tiles) = tiles(&mut self.dice, receivers.len(), self.plan.chunk_bytes);
            for (tile, receiver) in tiles.into_iter().zip(receivers.iter().flat_map(|receiver| [receiver; 2]))
            {
                self.judge.note_offer(of.site, Role::Device, &tile, &[*receiver]);
                self.members[index].offers.push(tile.clone());
                self.tiles.push((*receiver, tile));
            }
            manifest
        } else {
            model(of.device, ModelId(1), ModelKind::Global, seed, self.plan.chunk_bytes)
        };
        self.judge.note_offer(of.site, Role::Device, &offer, &receivers);
        self.members[index].offers.push(offer.clone());
        self.members[index].offer(offer, |node, offer| node.broadcast(TileId::WHOLE, offer, &receivers));
    }

    /// Offers each drone its next tile.
    fn send_tiles(&mut self) {
        while let Some(i) = self.tiles.iter().position(|(to, _)| !self.members[0].node.is_sending_tile(*to)) {
            let (to, tile) = self.tiles.remove(i);
            self.members[0].offer(tile, |node, offer| node.send_tile(to, offer));
        }
    }

    /// Kills a participant, fills a disk, or stops and starts the broker, while the attack lasts.
    fn strike(&mut self, now: Duration) -> Verdict {
        let (at, left) = self.trouble;
        if now < at || (left == 0 && !self.is_broker_down) {
            return Ok(());
        }
        self.trouble.0 = now + Duration::from_millis(200 + self.dice.below(6000) as u64);
        if std::mem::take(&mut self.is_broker_down) {
            self.network.start();
            return Ok(());
        }
        self.trouble.1 -= 1;
        let index = self.dice.below(self.members.len());
        match self.dice.below(5) {
            0 => {
                self.network.stop(self.dice.coin());
                self.is_broker_down = true;
            }
            1 => self.members[index].failing_writes = 2,
            _ => self.restart(index)?,
        }
        Ok(())
    }

    fn restart(&mut self, index: usize) -> Verdict {
        self.members[index].restart(&self.network, &mut self.judge)?;
        let Identity { site, role, .. } = self.members[index].identity;
        // An aggregator always offers its newest global model again.
        let is_global = |offer: &Offer| role == Role::Aggregator && !offer.header.model.is_tile();
        let is_untold = |offer: &&Offer| !self.judge.is_told(site, offer.header.into()) || is_global(offer);
        let again: Vec<Offer> = self.members[index].offers.iter().filter(is_untold).cloned().collect();
        for offer in again {
            let receivers = self.judge.receivers(site, offer.header.into());
            match (role, offer.header.model.is_tile()) {
                (Role::Device, _) => self.members[index].offer(offer, |node, offer| node.upload(offer)),
                (Role::Aggregator, true) => {
                    self.tiles.retain(|(_, tile)| tile.header != offer.header);
                    self.tiles.push((receivers[0], offer));
                }
                (Role::Aggregator, false) => {
                    self.members[index]
                        .offer(offer, |node, offer| node.broadcast(TileId::WHOLE, offer, &receivers));
                }
            }
        }
        Ok(())
    }
}
