//! Tests the built-in broker with real MQTT clients.

use std::sync::mpsc;
use std::time::{Duration, Instant};

use cosurf_aggregator::broker::{Broker, BrokerError, BrokerEvent, BrokerSettings};
use cosurf_link::{Role, UploadProgress};
use cosurf_tests::live::{Ground, upload};
use cosurf_tests::offers::{broker_address, identity, offer};
use cosurf_wire::{MAX_CHUNK_BYTES, ModelKind};

use crate::raw::{Hello, Raw};
use crate::station::loopback;

#[test]
fn a_model_of_several_megabytes() {
    let broker = Broker::start(loopback()).unwrap();
    let ground = Ground::start(broker_address(broker.address()), None, identity(Role::Aggregator, "ground"));
    let offer = offer("drone", 1, ModelKind::Local, 1, 300_000, MAX_CHUNK_BYTES as u32);
    let body = offer.body.clone();
    let start = Instant::now();
    let progress = upload(
        broker_address(broker.address()),
        None,
        identity(Role::Device, "drone"),
        offer,
        |_| {},
        |_| {},
    );
    println!("{} bytes in {:?}, {} sent", body.len(), start.elapsed(), progress.bytes_sent);
    assert_eq!(*ground.bodies.lock().unwrap(), [body]);
}

#[test]
fn stopped_and_started_in_mid_upload() {
    let broker = Broker::start(loopback()).unwrap();
    let (at, to) = (broker.address(), broker_address(broker.address()));
    let ground = Ground::start(to.clone(), None, identity(Role::Aggregator, "ground"));
    let offer = offer("drone", 1, ModelKind::Local, 1, 300_000, 8192);
    let body = offer.body.clone();
    let (mut broker, mut retries) = (Some(broker), 0);
    let restart = |progress: UploadProgress| {
        if progress.chunks_received > progress.chunks / 2 && broker.take().is_some() {
            std::thread::sleep(Duration::from_millis(300));
            std::thread::spawn(move || {
                std::thread::sleep(Duration::from_millis(500));
                std::mem::forget(Broker::start(at).unwrap());
            });
        }
    };
    upload(to, None, identity(Role::Device, "drone"), offer, restart, |reason| {
        println!("{reason}");
        retries += 1;
    });
    assert_eq!(*ground.bodies.lock().unwrap(), [body]);
    assert!(retries > 0, "the broker was never away");
}

#[test]
fn a_port_in_use_is_named() {
    let broker = Broker::start(loopback()).unwrap();
    let error = Broker::start(broker.address()).unwrap_err();
    assert!(matches!(error, BrokerError::PortInUse(_)));
    let text = error.to_string();
    assert!(
        text.contains(&broker.address().port().to_string()) && text.contains("choose another port"),
        "{text}"
    );
}

#[test]
fn a_port_is_free_after_shutdown() {
    let broker = Broker::start(loopback()).unwrap();
    let at = broker.address();
    broker.shutdown();
    Broker::start(at).unwrap();
}

#[test]
fn a_client_beyond_the_limit_is_refused_until_another_has_left() {
    let (say, events) = mpsc::channel();
    let settings = BrokerSettings { clients_max: 1, ..BrokerSettings::default() };
    let broker = Broker::start_with(loopback(), settings, move |event| say.send(event).unwrap()).unwrap();
    let connect = |id| Raw::hello(broker.address(), &Hello { id, ..Hello::default() });
    let first = connect("first");
    assert_eq!([first.1, connect("second").1, connect("third").1], [0, 0x97, 0x97]);
    let event = events.recv_timeout(Duration::from_secs(10)).unwrap();
    assert_eq!(event, BrokerEvent::Full { clients_max: 1 });
    assert!(event.to_string().contains("raise `clients_max`"));
    assert!(events.try_recv().is_err(), "a client that tries again is not told again");
    // The same client may come again; the older connection ends.
    let (mut older, (_newer, code)) = (first.0, connect("first"));
    assert_eq!((code, older.farewell()), (0, 0x8E));
    drop((older, _newer));
    let begun = Instant::now();
    while connect("second").1 != 0 {
        assert!(begun.elapsed() < Duration::from_secs(20), "the place of the first client is not given away");
        std::thread::sleep(Duration::from_millis(10));
    }
}
