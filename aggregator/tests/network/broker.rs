//! Tests the built-in broker with real MQTT clients.

use std::sync::mpsc;
use std::time::{Duration, Instant};

use cosurf_aggregator::broker::{Broker, BrokerError, BrokerEvent, BrokerSettings};
use cosurf_link::{
    Identity, MqttConfig, MqttTransport, Outgoing, Role, Transport, TransportEvent, UploadProgress, probe,
};
use cosurf_tests::live::{Ground, upload};
use cosurf_tests::offers::{broker_address, identity, offer};
use cosurf_wire::{MAX_CHUNK_BYTES, ModelId, ModelKind, Reply, Topic};

use crate::raw::{AN_HOUR, Hello, Raw};
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

/// What is published to a ground station that is away arrives when it is back, whoever has looked in between.
#[test]
fn a_look_at_the_broker_leaves_what_it_keeps() {
    let broker = Broker::start(loopback()).unwrap();
    let to = broker_address(broker.address());
    let config = |identity| MqttConfig { broker: to.clone(), identity, will: None, tls: None, login: None };
    let open = |start: fn(MqttConfig) -> MqttTransport, identity: Identity| {
        let mut transport = start(config(identity));
        assert_eq!(transport.poll(Duration::from_secs(20)), Some(TransportEvent::Connected));
        transport
    };
    let (ground, drone) = (identity(Role::Aggregator, "ground"), identity(Role::Device, "drone"));
    drop((open(MqttTransport::start, ground), open(MqttTransport::start, drone)));
    let up = Topic::LocalChunk { device: drone.device, model: ModelId(1), index: 0 }.to_text(&drone.site);
    let down = Topic::LocalReply { device: drone.device, reply: Reply::Plan }.to_text(&ground.site);
    for (role, name, topic) in
        [(Role::Device, "other", up.clone()), (Role::Aggregator, "above", down.clone())]
    {
        let mut writer = open(MqttTransport::start, identity(role, name));
        writer.publish(&Outgoing { topic, payload: vec![7], retain: false }).unwrap();
    }
    probe(config(ground)).unwrap();
    probe(config(drone)).unwrap();
    drop(open(MqttTransport::start_asking, drone));
    for (identity, topic) in [(ground, up), (drone, down)] {
        let mut back = open(MqttTransport::start, identity);
        let heard = back.poll(Duration::from_secs(5));
        let kept = TransportEvent::Incoming { topic: topic.as_str().to_owned(), payload: vec![7] };
        assert_eq!(heard, Some(kept), "{}", identity.device);
    }
    let new = identity(Role::Device, "new");
    probe(config(new)).unwrap();
    let id = new.client_id();
    let hello = Hello { id: &id, clean: false, properties: &AN_HOUR, ..Hello::default() };
    assert!(!Raw::resume(broker.address(), &hello).1, "the look has left a session");
}
