//! Whole fleets over a lossy, doubling, damaging, reordering network: every body arrives identical, in
//! bounded time, from any seed.
#![allow(clippy::unwrap_used)]

mod common;

use std::time::Duration;

use common::{Member, offer, run};
use cosurf_link::{Faults, InboxLimits, MemoryNetwork, ModelKey, Role};
use cosurf_wire::ModelKind;

const HARSH: Faults =
    Faults { loss: 0.3, duplication: 0.2, corruption: 0.02, delay_max: Duration::from_millis(200) };

#[test]
fn one_upload_over_a_clean_network() {
    let network = MemoryNetwork::new(1, Faults::NONE);
    let offer = offer("drone", 1, ModelKind::Local, 1, 5000, 4096);
    let body = offer.body.clone();
    let mut drone = Member::new(&network, Role::Device, "drone", InboxLimits::default());
    drone.node.upload(offer);
    let ground = Member::new(&network, Role::Aggregator, "ground", InboxLimits::default());
    let mut fleet = [drone, ground];
    run(&network, &mut fleet, Duration::from_secs(5), |fleet| !fleet[0].uploaded.is_empty());
    let key = fleet[0].uploaded[0];
    assert_eq!(fleet[1].disk[&key], body);
}

#[test]
fn thousands_of_seeds() {
    let mut worst = Duration::ZERO;
    for seed in 0..2000 {
        let network = MemoryNetwork::new(seed, HARSH);
        let offer = offer("drone", 1, ModelKind::Local, seed, 40 + (seed as usize * 37) % 2000, 1024);
        let body = offer.body.clone();
        let mut drone = Member::new(&network, Role::Device, "drone", InboxLimits::default());
        drone.node.upload(offer);
        let ground = Member::new(&network, Role::Aggregator, "ground", InboxLimits::default());
        let mut fleet = [drone, ground];
        run(&network, &mut fleet, Duration::from_secs(600), |fleet| !fleet[0].uploaded.is_empty());
        let key: ModelKey = fleet[0].uploaded[0];
        assert_eq!(fleet[1].disk[&key], body, "seed {seed}");
        worst = worst.max(network.now());
    }
    println!("worst of 2000 seeds: {worst:?}");
}
