//! A recorded mission, said again to another aggregator, gives the same global model.
#![allow(clippy::unwrap_used)]

#[path = "../../shared/link/tests/common/mod.rs"]
mod common;
#[path = "../../shared/link/tests/common/live.rs"]
mod live;

use std::fs::{self, File};
use std::io::{BufReader, BufWriter};
use std::ops::ControlFlow;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc;
use std::thread;
use std::time::{Duration, Instant};

use common::{credible, identity};
use cosurf_aggregator::broker::Broker;
use cosurf_aggregator::merge::MergeSettings;
use cosurf_aggregator::service::{Command, Expected, Service, ServiceConfig, ServiceEvent, global_ply};
use cosurf_link::mqtt::traffic::{ReplaySettings, record, replay};
use cosurf_link::recording::Recording;
use cosurf_link::{BrokerAddress, Faults, InboxLimits, MqttConfig, MqttTransport, Role};
use cosurf_wire::DeviceId;
use live::upload;

const PATIENCE: Duration = Duration::from_secs(120);
const DRONES: [&str; 2] = ["drone-1", "drone-2"];

fn broker() -> (Broker, BrokerAddress) {
    let broker = Broker::start(([127, 0, 0, 1], 0).into()).unwrap();
    let at = broker.address();
    (broker, BrokerAddress { host: at.ip().to_string(), port: at.port(), is_tls: false })
}

/// Serves in `folder` until there is a global model, which `fly` must bring about; returns its bytes.
fn serve(address: &BrokerAddress, folder: &Path, fly: impl FnOnce()) -> Vec<u8> {
    let ground = identity(Role::Aggregator, "ground");
    let service = Service::open(ServiceConfig {
        identity: ground,
        folder: folder.to_owned(),
        limits: InboxLimits::default(),
        expected: Expected::Devices(DRONES.map(|name| DeviceId::new(name).unwrap()).into()),
        merge: MergeSettings { epochs: 1, ..MergeSettings::default() },
        threads: 1,
    })
    .unwrap();
    let (commands, orders) = mpsc::channel();
    let (say, events) = mpsc::channel();
    let config = MqttConfig { broker: address.clone(), identity: ground, tls: None };
    let station = thread::spawn(move || {
        let begun = Instant::now();
        let mut transport = MqttTransport::start(config);
        service.run(
            &mut transport,
            || begun.elapsed(),
            &orders,
            |event| {
                let _ = say.send(event);
                ControlFlow::Continue(())
            },
        )
    });
    assert_eq!(events.recv_timeout(PATIENCE).unwrap(), ServiceEvent::Connected);
    fly();
    while !matches!(events.recv_timeout(PATIENCE).unwrap(), ServiceEvent::Merged { .. }) {}
    commands.send(Command::Finish).unwrap();
    station.join().unwrap();
    fs::read(global_ply(folder)).unwrap()
}

/// A flight of two drones that is listened to; returns the global model.
fn recorded_flight(folder: &Path, file: &Path) -> Vec<u8> {
    let (_broker, address) = broker();
    let stop = Arc::new(AtomicBool::new(false));
    let (listening, stopping) = (address.clone(), Arc::clone(&stop));
    let out = BufWriter::new(File::create(file).unwrap());
    let recorder = thread::spawn(move || record(&listening, None, "gs/v1/#", out, &stopping).unwrap());
    let global = serve(&address, folder, || {
        // The ground's birth is retained: once that is in the file, nothing is missed any more.
        let begun = Instant::now();
        while fs::metadata(file).unwrap().len() < 20 {
            assert!(begun.elapsed() < PATIENCE, "nothing is recorded");
            thread::sleep(Duration::from_millis(20));
        }
        for drone in DRONES {
            let mut offer = credible(drone, 3000);
            offer.header.chunk_bytes = 4096;
            upload(address.clone(), None, identity(Role::Device, drone), offer, |_| {}, |_, _| {});
        }
    });
    stop.store(true, Ordering::Relaxed);
    assert!(recorder.join().unwrap() > 20, "hardly anything was recorded");
    global
}

#[test]
fn a_recorded_mission_gives_the_same_global_model() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("flight.log");
    let first = recorded_flight(&folder.path().join("first"), &file);
    let faults = Faults { duplication: 0.3, ..Faults::NONE };
    for (name, speed, faults) in
        [("fast", None, Faults::NONE), ("doubled", None, faults), ("paced", Some(5.0), Faults::NONE)]
    {
        let (_broker, address) = broker();
        let again = serve(&address, &folder.path().join(name), || {
            let recording = Recording::open(BufReader::new(File::open(&file).unwrap())).unwrap();
            let settings = ReplaySettings { speed, faults, seed: 1 };
            let stop = AtomicBool::new(false);
            let sent = replay(&address, None, recording, &settings, &stop).unwrap();
            println!("{name}: {sent} messages");
        });
        assert!(again == first, "{name}: another global model");
    }
}
