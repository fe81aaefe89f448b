//! Uploads over Mosquitto: while the broker is killed or stopped, with TLS, and with the example
//! configuration in `shared/docs`.
#![allow(clippy::unwrap_used)]

use std::time::{Duration, Instant};

use cosurf_link::{
    BrokerAddress, Identity, MqttConfig, MqttTransport, Outgoing, Role, TlsFiles, Transport, TransportEvent,
    UploadProgress, probe,
};
use cosurf_tests::live::{Ground, upload};
use cosurf_tests::mosquitto::{Authority, Mosquitto, PLAIN, example, tls};
use cosurf_tests::offers::{identity, offer};
use cosurf_tests::web_door::WebDoor;
use cosurf_wire::{DeviceId, ModelId, ModelKind, Topic};

fn interrupted(how: fn(&mut Mosquitto)) {
    let folder = tempfile::tempdir().unwrap();
    let Some(mut broker) = Mosquitto::start(folder.path(), PLAIN, false) else { return };
    let ground = Ground::start(broker.address.clone(), None, identity(Role::Aggregator, "ground"));
    let offer = offer("drone", 1, ModelKind::Local, 1, 100_000, 8192);
    let body = offer.body.clone();
    let (address, mut times, mut retries) = (broker.address.clone(), 0, 0);
    let restart = |progress: UploadProgress| {
        if times < 3 && progress.chunks_received > progress.chunks * (times + 1) / 4 {
            times += 1;
            how(&mut broker);
            broker.start_again();
        }
    };
    upload(address, None, identity(Role::Device, "drone"), offer, restart, |reason| {
        println!("{reason}");
        retries += 1;
    });
    assert_eq!(*ground.bodies.lock().unwrap(), [body]);
    assert!(times == 3 && retries > 0, "the broker was never away");
}

#[test]
fn killed_three_times_in_mid_upload() {
    interrupted(Mosquitto::kill);
}

#[test]
fn stopped_three_times_in_mid_upload() {
    interrupted(Mosquitto::terminate);
}

/// Connects to the broker, and returns the first event.
fn first_event(config: MqttConfig) -> TransportEvent {
    MqttTransport::start(config).poll(Duration::from_secs(20)).unwrap()
}

#[test]
fn fault_17_expired_revoked_and_foreign_certificates() {
    let folder = tempfile::tempdir().unwrap();
    let authority = Authority::new(folder.path());
    let good = authority.client("good", "drone", 30);
    let late = authority.client("late", "drone", -1);
    let revoked = authority.client("revoked-drone", "drone", 30);
    authority.revoke(&["revoked-drone"]);
    let elsewhere = tempfile::tempdir().unwrap();
    let mut stranger = Authority::new(elsewhere.path()).client("stranger", "drone", 30);
    let foreign_ca = std::mem::replace(&mut stranger.ca, good.ca.clone());
    let Some(broker) = Mosquitto::start(folder.path(), &example(folder.path()), true) else { return };
    let connect = |files| {
        let tls = Some(tls(files));
        first_event(MqttConfig {
            broker: broker.address.clone(),
            identity: identity(Role::Device, "drone"),
            will: None,
            tls,
            login: None,
        })
    };
    assert_eq!(connect(&good), TransportEvent::Connected);
    for (files, told) in
        [(&late, "has expired"), (&revoked, "is revoked"), (&stranger, "the broker's own authority")]
    {
        let event = connect(files);
        println!("{event:?}");
        let is_told = matches!(&event, TransportEvent::Disconnected { reason, .. } if reason.contains(told));
        assert!(is_told, "{told}: {event:?}");
    }
    // A client refuses a broker whose certificate comes from another authority.
    let mut fooled = good.clone();
    fooled.ca = foreign_ca;
    assert!(
        matches!(connect(&fooled), TransportEvent::Disconnected { reason, .. } if reason.contains("TLS"))
    );
}

#[test]
fn tls_at_a_port_without_it_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let files = Authority::new(folder.path()).client("drone", "drone", 30);
    let Some(broker) = Mosquitto::start(folder.path(), PLAIN, false) else { return };
    let event = first_event(MqttConfig {
        broker: BrokerAddress { is_tls: true, ..broker.address.clone() },
        identity: identity(Role::Device, "drone"),
        will: None,
        tls: Some(tls(&files)),
        login: None,
    });
    println!("{event:?}");
    assert!(matches!(event, TransportEvent::Disconnected { reason, .. } if reason.contains("mqtt://")));
}

/// An upload by WebSocket, with and without TLS, to a broker behind a listener that cuts packets anywhere.
#[test]
fn models_arrive_by_web_socket() {
    let folder = tempfile::tempdir().unwrap();
    let authority = Authority::new(folder.path());
    let server = authority.files("server");
    let (cert, key) = (server.cert.clone().unwrap(), server.key.clone().unwrap());
    let trusting = TlsFiles { cert: None, key: None, ..server };
    let Some(broker) = Mosquitto::start(folder.path(), PLAIN, false) else { return };
    for (files, trusted) in [(None, None), (Some((&*cert, &*key)), Some(&trusting))] {
        let Some(door) = WebDoor::start(&broker.address, files) else { return };
        let (address, tls) = (&door.address, trusted.map(tls));
        let ground = Ground::start(address.clone(), tls.clone(), identity(Role::Aggregator, "ground"));
        let number = if files.is_some() { 2 } else { 1 };
        let offer = offer("drone", number, ModelKind::Local, 1, 20_000, 65_536);
        let body = offer.body.clone();
        upload(address.clone(), tls.clone(), identity(Role::Device, "drone"), offer, |_| {}, |_| {});
        assert_eq!(*ground.bodies.lock().unwrap(), [body]);
        drop(ground);
        let elsewhere = BrokerAddress { web_path: Some("/elsewhere".to_owned()), ..address.clone() };
        let nowhere = BrokerAddress { port: broker.address.port, ..address.clone() };
        for (broker, told) in [(elsewhere, "name the path"), (nowhere, "use mqtt")] {
            let (identity, tls) = (identity(Role::Device, "drone"), tls.clone());
            let event = first_event(MqttConfig { broker, identity, will: None, tls, login: None });
            let is_told =
                matches!(&event, TransportEvent::Disconnected { reason, .. } if reason.contains(told));
            assert!(is_told, "{told}: {event:?}");
        }
    }
}

#[test]
fn the_example_configuration_passes_models_and_blocks_forgeries() {
    let folder = tempfile::tempdir().unwrap();
    let authority = Authority::new(folder.path());
    let [ground_files, drone_files, thief_files] =
        ["aggregator", "drone", "thief"].map(|name| authority.client(name, name, 30));
    let Some(broker) = Mosquitto::start(folder.path(), &example(folder.path()), true) else { return };
    let ground = identity(Role::Aggregator, "ground");
    let ground = Ground::start(broker.address.clone(), Some(tls(&ground_files)), ground);

    // The thief's certificate does not let the thief publish under the drone's topics.
    let thief = Identity { device: DeviceId::new("thief").unwrap(), ..identity(Role::Device, "thief") };
    let config = MqttConfig {
        broker: broker.address.clone(),
        identity: thief,
        will: None,
        tls: Some(tls(&thief_files)),
        login: None,
    };
    let mut transport = MqttTransport::start(config);
    assert_eq!(transport.poll(Duration::from_secs(20)), Some(TransportEvent::Connected));
    let forged = offer("drone", 9, ModelKind::Local, 9, 10, 8192);
    let device = DeviceId::new("drone").unwrap();
    let topic = Topic::LocalHeader { device, model: ModelId(9) }.to_text(&thief.site);
    let mut payload = vec![0; 1024];
    let header = cosurf_wire::Message::Header(forged.header);
    let payload = header.encode(&mut payload).unwrap().to_vec();
    let forged = Outgoing { topic, payload, retain: true };
    for _ in 0..2 {
        transport.publish(&forged).unwrap();
    }
    // The thief is told so, once.
    let told = transport.poll(Duration::from_secs(20));
    let is_told = |event: &TransportEvent| matches!(event, TransportEvent::Denied { reason } if reason.contains("access"));
    assert!(told.as_ref().is_some_and(is_told), "{told:?}");
    assert_eq!(transport.poll(Duration::from_millis(200)), None);

    let offer = offer("drone", 1, ModelKind::Local, 1, 20_000, 65_536);
    let body = offer.body.clone();
    let begun = Instant::now();
    let drone = identity(Role::Device, "drone");
    upload(broker.address.clone(), Some(tls(&drone_files)), drone, offer, |_| {}, |_| {});
    println!("{} bytes by TLS in {:?}", body.len(), begun.elapsed());
    assert_eq!(*ground.bodies.lock().unwrap(), [body]);
    assert_eq!(*ground.announced.lock().unwrap(), [ModelId(1)], "the forged announcement was delivered");
}

/// A thief with a certificate of its own uses the aggregator's client id, and another site.
#[test]
fn attack_14_name_client_id_and_device_are_one() {
    let folder = tempfile::tempdir().unwrap();
    let authority = Authority::new(folder.path());
    let [ground_files, thief_files] = ["aggregator", "thief"].map(|name| authority.client(name, name, 30));
    let settings = example(folder.path());
    let Some(broker) = Mosquitto::start(folder.path(), &settings, true) else { return };
    let connect = |identity, files| {
        let (broker, tls) = (broker.address.clone(), Some(tls(files)));
        let mut transport =
            MqttTransport::start(MqttConfig { broker, identity, will: None, tls, login: None });
        assert_eq!(transport.poll(Duration::from_secs(20)), Some(TransportEvent::Connected));
        transport
    };
    let at_site = identity(Role::Aggregator, "ground");
    let mut ground = connect(at_site, &ground_files);
    let thief = connect(at_site, &thief_files);
    let event = ground.poll(Duration::from_secs(1));
    assert_eq!(event, None, "the thief has taken the place of the aggregator");
    drop((thief, ground));
    // The aggregator may read another site, but the thief may not write there, not even under its own name.
    let list = folder.path().join("cosurf.acl");
    let text = std::fs::read_to_string(&list).unwrap();
    let wider = text.replace("topic readwrite gs/v1/site/#", "topic readwrite gs/v1/#");
    assert_ne!(text, wider);
    std::fs::write(&list, wider).unwrap();
    broker.reload();
    let elsewhere = cosurf_wire::SiteId::new("elsewhere").unwrap();
    let mut ground = connect(Identity { site: elsewhere, ..at_site }, &ground_files);
    let mut thief = connect(identity(Role::Device, "thief"), &thief_files);
    let topic = Topic::State { device: DeviceId::new("thief").unwrap() }.to_text(&elsewhere);
    thief.publish(&Outgoing { topic, payload: vec![1], retain: false }).unwrap();
    assert_eq!(ground.poll(Duration::from_secs(1)), None, "the thief writes on another site");
}

/// What is published to a ground station that is away arrives when it is back, although `doctor` has looked in between. The
/// example configuration takes client ids from certificates.
#[test]
fn a_look_at_the_broker_leaves_what_it_keeps() {
    let folder = tempfile::tempdir().unwrap();
    let authority = Authority::new(folder.path());
    let files = ["aggregator", "drone", "new"].map(|name| authority.client(name, name, 30));
    for (settings, is_tls) in [(PLAIN.to_owned(), false), (example(folder.path()), true)] {
        let Some(broker) = Mosquitto::start(folder.path(), &settings, is_tls) else { return };
        let config = |identity: Identity, files| {
            let (broker, tls) = (broker.address.clone(), is_tls.then(|| tls(files)));
            MqttConfig { broker, identity, will: None, tls, login: None }
        };
        let connect = |identity, files| {
            let mut transport = MqttTransport::start(config(identity, files));
            assert_eq!(transport.poll(Duration::from_secs(20)), Some(TransportEvent::Connected));
            transport
        };
        let (at_site, drone) = (identity(Role::Aggregator, "ground"), identity(Role::Device, "drone"));
        drop(connect(at_site, &files[0]));
        let topic =
            Topic::LocalChunk { device: drone.device, model: ModelId(1), index: 0 }.to_text(&drone.site);
        let chunk = Outgoing { topic: topic.clone(), payload: vec![7], retain: false };
        connect(drone, &files[1]).publish(&chunk).unwrap();
        for _ in 0..2 {
            probe(config(at_site, &files[0])).unwrap();
        }
        let event = connect(at_site, &files[0]).poll(Duration::from_secs(5));
        let kept = TransportEvent::Incoming { topic: topic.as_str().to_owned(), payload: vec![7] };
        assert_eq!(event, Some(kept), "TLS: {is_tls}");
        probe(config(identity(Role::Device, "new"), &files[2])).unwrap();
    }
}
