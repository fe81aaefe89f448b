//! Two hundred agents upload to one aggregator at once. The aggregator's memory must stay within its limit, and
//! one upload that stalls must not slow the others.
#![cfg(target_os = "linux")]
#![allow(clippy::unwrap_used)]

use std::fs;
use std::net::TcpListener;
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use cosurf_link::{BrokerAddress, InboxLimits, MqttConfig, MqttTransport, Node, NodeEvent, Offer, Role};
use cosurf_tests::offers::{identity, offer};
use cosurf_tests::programs::program;
use cosurf_tests::results::{Column, Measurement};
use cosurf_tests::usage::peak_bytes;
use cosurf_wire::{DeviceId, MAX_CHUNK_BYTES, ModelKind};

const AGENTS: u64 = 200;
const INBOX_BYTES: u64 = 64 << 20;
/// Limit on the memory of the aggregator's process without the inbox. 64 MiB are for the program, the broker's
/// longest queue (16 MiB) and the link's copy of that queue. Each connection needs two threads, and buffers for
/// the largest packets.
const BESIDE_BYTES: u64 = (64 << 20) + AGENTS * (512 << 10);
const PATIENCE: Duration = Duration::from_secs(500);

/// An aggregator with a broker of its own; killed when dropped.
struct Aggregator(Child);

impl Drop for Aggregator {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

impl Aggregator {
    fn start(folder: &std::path::Path) -> (Self, BrokerAddress) {
        let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let config = folder.join("aggregator.toml");
        let out = folder.join("out").display().to_string();
        // The quorum is never reached, so nothing is merged.
        let text = format!(
            "site = \"site\"\nout = \"{out}\"\nbind = \"127.0.0.1:{port}\"\nmemory_bytes = {INBOX_BYTES}\n\
             quorum = 100000\n"
        );
        fs::write(&config, text).unwrap();
        let mut command = Command::new(program("cosurf-aggregator"));
        command.args(["run", "--config"]).arg(config).stdin(Stdio::null()).stdout(Stdio::null());
        let address = BrokerAddress::plain("127.0.0.1", port);
        (Self(command.spawn().unwrap()), address)
    }

    /// Peak resident memory, bytes.
    fn peak_bytes(&self) -> u64 {
        peak_bytes(self.0.id()).unwrap()
    }
}

/// Uploads a model. If `stalls`, stops working at the first progress, and disconnects a minute later.
fn agent(address: BrokerAddress, mut offer: Offer, number: u64, stalls: bool) {
    let name = format!("agent-{number}");
    offer.header.device = DeviceId::new(&name).unwrap();
    let identity = identity(Role::Device, &name);
    let mut transport =
        MqttTransport::start(MqttConfig { broker: address, identity, will: None, tls: None, login: None });
    let mut node = Node::new(identity, InboxLimits::default(), &[]);
    node.upload(offer);
    let begun = Instant::now();
    while begun.elapsed() < PATIENCE {
        match node.step(&mut transport, || begun.elapsed(), Duration::from_millis(100)) {
            Some(NodeEvent::Progress(..)) if stalls => {
                thread::sleep(Duration::from_secs(60));
                return;
            }
            Some(NodeEvent::Uploaded(..)) => return,
            _ => {}
        }
    }
    panic!("{name} does not end");
}

/// Lets all agents upload at once. Returns the time until all agents but the first are done, and the aggregator's
/// peak memory, bytes.
fn crowd(first_stalls: bool) -> (Duration, u64) {
    let folder = tempfile::tempdir().unwrap();
    let (aggregator, address) = Aggregator::start(folder.path());
    let offer = offer("agent", 1, ModelKind::Local, 1, 30_000, MAX_CHUNK_BYTES as u32);
    let begun = Instant::now();
    let start = |number| {
        let (address, offer) = (address.clone(), offer.clone());
        thread::spawn(move || agent(address, offer, number, first_stalls && number == 0))
    };
    let mut threads: Vec<_> = (0..AGENTS).map(start).collect();
    let first = threads.remove(0);
    threads.into_iter().for_each(|thread| thread.join().unwrap());
    let time = begun.elapsed();
    let stored = fs::read_dir(folder.path().join("out/models")).unwrap().count() as u64;
    assert!(stored >= AGENTS - 1, "{stored} are stored");
    let peak = aggregator.peak_bytes();
    first.join().unwrap();
    println!(
        "{AGENTS} agents with {} bytes each, one stalls: {first_stalls}: {time:.1?}, peak {} MiB",
        offer.body.len(),
        peak >> 20
    );
    (time, peak)
}

/// Run it with `cargo run --release -p cosurf-tests --bin results -- crowd`.
#[test]
#[ignore = "takes minutes"]
fn two_hundred_agents_at_once() {
    let (alone, peak) = crowd(false);
    let (beside, peak_beside) = crowd(true);
    let columns = [Column::memory(), Column::new("allowed for models", "MiB", 0)];
    let mut measurement = Measurement::start("crowd", &columns);
    for (name, peak) in [("200 agents at once", peak), ("the same, one of them stalls", peak_beside)] {
        measurement.row(name, &[peak, INBOX_BYTES].map(|bytes| Some((bytes >> 20) as f64)));
    }
    measurement.finish().unwrap();
    assert!(peak.max(peak_beside) <= INBOX_BYTES + BESIDE_BYTES, "{} MiB", peak.max(peak_beside) >> 20);
    assert!(beside < alone * 3 / 2 + Duration::from_secs(5), "{beside:?} instead of {alone:?}");
}
