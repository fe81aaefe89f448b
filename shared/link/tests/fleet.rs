//! Whole fleets over slow networks that lose, duplicate, damage, truncate and delay messages. Meanwhile
//! members are killed and the broker restarts. From any seed, every body must arrive unchanged, once, and in
//! bounded time.
#![allow(clippy::unwrap_used)]

use std::num::NonZeroU32;
use std::ops::Range;
use std::time::Duration;

use cosurf_link::faults::Dice;
use cosurf_link::{Faults, InboxLimits, MemoryNetwork, ModelKey, Node, Offer, Outages, Role};
use cosurf_tests::fleet::{Member, run_until};
use cosurf_tests::offers::{offer, pooled_offer};
use cosurf_wire::{DeviceId, ModelHeader, ModelKind, TileId};

/// Number of seeds in one test run. Two tests use half of them each.
const SEEDS: u64 = 10_000;
/// Virtual time at which a test fails if uploads are not finished. The global model that follows must arrive
/// before twice this time.
const PATIENCE: Duration = Duration::from_secs(4 * 3600);

#[test]
fn one_upload_over_a_clean_network() {
    let network = MemoryNetwork::new(1, Faults::NONE);
    let offer = offer("drone", 1, ModelKind::Local, 1, 5000, 4096);
    let body = offer.body.clone();
    let mut drone = Member::new(&network, Role::Device, "drone", InboxLimits::default());
    drone.node.upload(offer);
    let ground = Member::new(&network, Role::Aggregator, "ground", InboxLimits::default());
    let mut fleet = [drone, ground];
    run_until(&network, &mut fleet, Duration::from_secs(5), |fleet| !fleet[0].uploaded.is_empty());
    let key = fleet[0].uploaded[0];
    assert_eq!(fleet[1].disk[&key].1, body);
}

#[test]
fn ten_thousand_fleets_first_half() {
    fly_all(0..SEEDS / 2);
}

#[test]
fn ten_thousand_fleets_second_half() {
    fly_all(SEEDS / 2..SEEDS);
}

/// Like the two tests above, with ten times as many seeds, which those tests do not use. Run it with
/// `cargo test -p cosurf-link --test fleet -- --ignored`.
#[test]
#[ignore = "takes minutes"]
fn a_hundred_thousand_fleets() {
    fly_all(SEEDS..11 * SEEDS);
}

fn fly_all(seeds: Range<u64>) {
    let (mut worst, mut kills) = (Duration::ZERO, 0);
    for seed in seeds.clone() {
        let trial = std::panic::catch_unwind(|| fly(seed));
        let (time, killed) = trial.unwrap_or_else(|_| panic!("seed {seed} fails"));
        worst = worst.max(time);
        kills += killed;
    }
    println!("seeds {seeds:?}: slowest {worst:?} of virtual time, {kills} members killed");
    assert!(kills > seeds.end - seeds.start, "hardly any member was killed");
}

/// The inbox never exceeds its limits, however many drones upload, and a stalled upload does not block the
/// other uploads.
#[test]
fn two_hundred_at_once_within_the_limits() {
    let limits =
        InboxLimits { body_bytes_max: 1 << 16, total_bytes_max: 1 << 18, models_max: 40, stored_max: 1000 };
    let network = MemoryNetwork::new(200, Faults::NONE);
    let mut fleet = vec![Member::new(&network, Role::Aggregator, "ground", limits)];
    for i in 0..200 {
        let name = format!("drone-{i}");
        let mut drone = Member::new(&network, Role::Device, &name, InboxLimits::default());
        drone.node.upload(pooled_offer(&name, 1, ModelKind::Local, i, 1024));
        fleet.push(drone);
    }
    let (mut most, mut is_stalled) = (0, false);
    run_until(&network, &mut fleet, PATIENCE, |fleet| {
        most = most.max(fleet[0].node.unfinished_bytes());
        assert!(most <= limits.total_bytes_max, "{most} bytes");
        if !is_stalled && most > 0 {
            // The aggregator has accepted an upload of this drone. From now on the drone sends nothing.
            is_stalled = true;
            let idle = Node::new(fleet[1].identity, InboxLimits::default(), &[]);
            fleet[1].node = idle;
        }
        fleet[2..].iter().all(|drone| !drone.uploaded.is_empty())
    });
    println!("at most {most} bytes at once, all uploaded after {:?}", network.now());
    assert!(most > limits.total_bytes_max / 2, "the limit was never near: {most}");
}

/// Random faults, from none to many, on lines from 4 kB/s (radio) to 1 MB/s (cable) or without a limit.
fn random_faults(dice: &mut Dice) -> Faults {
    let mut up_to = |most: f64| most * dice.below(1001) as f64 / 1000.0;
    let (loss, duplication, corruption, truncation) = (up_to(0.3), up_to(0.2), up_to(0.03), up_to(0.03));
    let delay_max = Duration::from_secs_f64(up_to(0.4));
    let bytes_per_s = [None, NonZeroU32::new(1 << (12 + dice.below(9)))][dice.below(2) as usize];
    let outages = Outages {
        interval_mean: Duration::from_secs(5 + dice.below(40)),
        duration_mean: Duration::from_secs(1 + dice.below(20)),
    };
    Faults {
        loss,
        duplication,
        corruption,
        truncation,
        delay_min: delay_max / 4,
        delay_max,
        bytes_per_s,
        outages: dice.chance(0.5).then_some(outages),
    }
}

/// One to four drones upload. Then the aggregator sends a global model to all of them. Meanwhile members are
/// killed, disks are full and the broker restarts. Returns the virtual time at the end and the number of
/// kills.
fn fly(seed: u64) -> (Duration, u64) {
    let mut dice = Dice::new(seed ^ 0xF1EE7);
    let network = MemoryNetwork::new(seed, random_faults(&mut dice));
    let mut fleet = vec![Member::new(&network, Role::Aggregator, "ground", InboxLimits::default())];
    let mut offers = Vec::new();
    for drone in 0..1 + dice.below(4) {
        let name = format!("drone-{drone}");
        let offer = pooled_offer(&name, 1, ModelKind::Local, seed + drone, 1024);
        let mut member = Member::new(&network, Role::Device, &name, InboxLimits::default());
        member.node.upload(offer.clone());
        fleet.push(member);
        offers.push(offer);
    }
    let mut trouble = Trouble::new(dice);
    run_until(&network, &mut fleet, PATIENCE, |fleet| {
        trouble.strike(&network, fleet, |member, fleet| {
            if let Some(offer) = member.checked_sub(1).map(|drone| &offers[drone]) {
                fleet[member].uploaded.clear();
                fleet[member].node.upload(offer.clone());
            }
        });
        fleet[1..].iter().all(|drone| !drone.uploaded.is_empty())
    });
    check(&fleet[0], &offers);

    let global = pooled_offer("ground", 1, ModelKind::Global, seed / 7, 1024);
    let receivers: Vec<DeviceId> = fleet[1..].iter().map(|drone| drone.identity.device).collect();
    let broadcast = |fleet: &mut [Member]| {
        fleet[0].uploaded.clear();
        fleet[0].node.broadcast(TileId::WHOLE, global.clone(), &receivers);
    };
    broadcast(&mut fleet);
    run_until(&network, &mut fleet, 2 * PATIENCE, |fleet| {
        trouble.strike(&network, fleet, |member, fleet| {
            if member == 0 {
                broadcast(fleet);
            }
        });
        !fleet[0].uploaded.is_empty()
    });
    fleet[1..].iter().for_each(|drone| check(drone, std::slice::from_ref(&global)));
    (network.now(), trouble.killed)
}

/// Checks that the disk holds exactly the offered models, byte for byte, and that each was written once.
fn check(member: &Member, offers: &[Offer]) {
    let name = member.identity.device;
    assert_eq!(member.disk.len(), offers.len(), "{name} has too much or too little");
    for offer in offers {
        let (header, body) = &member.disk[&ModelKey::from(offer.header)];
        // Over a line that breaks often, chunks may have become smaller.
        assert!(header.chunk_bytes <= offer.header.chunk_bytes, "{name}");
        assert_eq!(ModelHeader { chunk_bytes: offer.header.chunk_bytes, ..*header }, offer.header, "{name}");
        assert!(body == &offer.body, "{name} has other bytes");
    }
    assert_eq!(member.stored_twice, 0, "{name} stored a model twice");
}

/// Kills, full disks and broker restarts, drawn from a seed.
struct Trouble {
    dice: Dice,
    killed: u64,
    left: u64,
    next: Duration,
    is_broker_down: bool,
}

impl Trouble {
    fn new(mut dice: Dice) -> Self {
        let left = 1 + dice.below(6);
        Self { dice, killed: 0, left, next: Duration::ZERO, is_broker_down: false }
    }

    /// Causes the next fault, or restarts the broker, if this is due. Calls `revive` with the index of a
    /// member that was restarted.
    fn strike(
        &mut self,
        network: &MemoryNetwork,
        fleet: &mut [Member],
        revive: impl FnOnce(usize, &mut [Member]),
    ) {
        if network.now() < self.next {
            return;
        }
        self.next = network.now() + Duration::from_millis(20 + self.dice.below(3000));
        if self.is_broker_down {
            network.start();
            self.is_broker_down = false;
        } else if self.left > 0 {
            self.left -= 1;
            let member = self.dice.below(fleet.len() as u64) as usize;
            match self.dice.below(4) {
                0 => {
                    network.stop(self.dice.chance(0.5));
                    self.is_broker_down = true;
                }
                1 => fleet[member].failing_writes = 2,
                _ => {
                    fleet[member].restart(network);
                    self.killed += 1;
                    revive(member, fleet);
                }
            }
        }
    }
}
