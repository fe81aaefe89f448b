//! A recorded mission, replayed to another aggregator, gives the same global model.

use std::fs::{self, File};
use std::io::{self, BufReader, BufWriter};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::thread;
use std::time::{Duration, Instant};

use cosurf_aggregator::broker::Broker;
use cosurf_aggregator::merge::MergeSettings;
use cosurf_aggregator::service::{ServiceEvent, global_ply};
use cosurf_link::mqtt::traffic::{ConnectionNews, ReplaySettings, TrafficError, record, replay};
use cosurf_link::recording::Recording;
use cosurf_link::{BrokerAddress, Faults, Role};
use cosurf_tests::live::upload;
use cosurf_tests::offers::{broker_address, identity, mergeable_offer};

use crate::station::{Station, loopback};

const PATIENCE: Duration = Duration::from_secs(120);
const DRONES: [&str; 2] = ["drone-1", "drone-2"];

/// Runs a service in `folder` until the models that `fly` sends are merged. Returns the bytes of the global
/// model's file.
fn serve(address: &BrokerAddress, folder: &Path, fly: impl FnOnce()) -> Vec<u8> {
    let merge = MergeSettings { epochs: 1, ..MergeSettings::default() };
    let station = Station::start(folder, address.clone(), DRONES, merge);
    station.wait_for(|event| *event == ServiceEvent::Connected);
    fly();
    station.wait_for(|event| matches!(event, ServiceEvent::Merged { .. }));
    station.finish();
    fs::read(global_ply(folder)).unwrap()
}

/// Records the uploads of two drones into `file`. Returns the bytes of the global model's file.
fn recorded_flight(folder: &Path, file: &Path) -> Vec<u8> {
    let broker = Broker::start(loopback()).unwrap();
    let address = broker_address(broker.address());
    let stop = Arc::new(AtomicBool::new(false));
    let (listening, stopping) = (address.clone(), Arc::clone(&stop));
    let out = BufWriter::new(File::create(file).unwrap());
    let recorder =
        thread::spawn(move || record(&listening, None, None, "gs/v1/#", out, &stopping, drop).unwrap());
    let global = serve(&address, folder, || {
        // The broker retains the aggregator's state message. Once the file has this message, the recorder has
        // subscribed.
        let begun = Instant::now();
        while fs::metadata(file).unwrap().len() < 20 {
            assert!(begun.elapsed() < PATIENCE, "nothing is recorded");
            thread::sleep(Duration::from_millis(20));
        }
        for drone in DRONES {
            let mut offer = mergeable_offer(drone, 3000);
            offer.header.chunk_bytes = 4096;
            upload(address.clone(), None, identity(Role::Device, drone), offer, |_| {}, |_| {});
        }
    });
    stop.store(true, Ordering::Relaxed);
    assert!(recorder.join().unwrap() > 20, "hardly any message was recorded");
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
        let broker = Broker::start(loopback()).unwrap();
        let address = broker_address(broker.address());
        let again = serve(&address, &folder.path().join(name), || {
            let recording = Recording::open(BufReader::new(File::open(&file).unwrap())).unwrap();
            let settings = ReplaySettings { speed, faults, seed: 1 };
            let stop = AtomicBool::new(false);
            let (sent, lost) = replay(&address, None, None, recording, &settings, &stop).unwrap();
            println!("{name}: {sent} messages");
            assert_eq!(lost.places, 0);
        });
        assert!(again == first, "{name}: another global model");
    }
}

/// The broker is away for longer than the attempts of a first connection take.
#[test]
fn a_recording_outlasts_its_broker_and_only_a_first_connection_gives_up() {
    let broker = Broker::start(loopback()).unwrap();
    let at = broker.address();
    let address = broker_address(at);
    let stop = Arc::new(AtomicBool::new(false));
    let (listening, stopping) = (address.clone(), Arc::clone(&stop));
    let (say, hear) = mpsc::channel();
    let recorder = thread::spawn(move || {
        let tell = |news| say.send(news).unwrap();
        record(&listening, None, None, "gs/v1/#", io::sink(), &stopping, tell)
    });
    thread::sleep(Duration::from_secs(1));
    broker.shutdown();
    let first = hear.recv_timeout(PATIENCE).unwrap();
    assert!(matches!(first, ConnectionNews::Lost { .. }), "{first:?}");
    thread::sleep(Duration::from_secs(6));
    let given_up = record(&address, None, None, "#", io::sink(), &AtomicBool::new(false), drop);
    assert!(matches!(given_up, Err(TrafficError::NoBroker { .. })), "{given_up:?}");
    assert!(!recorder.is_finished(), "the recording has ended");
    let _broker = Broker::start(at).unwrap();
    while hear.recv_timeout(PATIENCE).unwrap() != ConnectionNews::Back {}
    stop.store(true, Ordering::Relaxed);
    recorder.join().unwrap().unwrap();
}
