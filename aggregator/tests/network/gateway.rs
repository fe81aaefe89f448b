//! A mission with one device on a radio and one on the network: the service treats both alike.

use std::fs;
use std::io;
use std::num::NonZeroU32;
use std::path::Path;
use std::sync::mpsc;
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use cosurf_aggregator::broker::{Broker, Reach};
use cosurf_aggregator::gateway::{Gateway, GatewayEvent};
use cosurf_aggregator::merge::MergeSettings;
use cosurf_aggregator::service::ServiceEvent;
use cosurf_link::serial::{DEVICE_MESSAGE_BYTES, GATEWAY_MESSAGE_BYTES};
use cosurf_link::{
    Identity, InboxLimits, MqttConfig, MqttTransport, Node, NodeEvent, Offer, Outgoing, Role, SerialConfig,
    SerialTransport, Transport, TransportEvent,
};
use cosurf_tests::mosquitto::{Authority, Mosquitto, tls};
use cosurf_tests::offers::{broker_address, identity, mergeable_offer};
use cosurf_wire::{DeviceId, Message, ModelId, State, Topic};
use serialport::{SerialPort, TTYPort};

use crate::station::{Station, loopback};

const PATIENCE: Duration = Duration::from_secs(60);

/// One end of a serial cable that carries 300 kB/s.
fn line(mut port: TTYPort, session: u64, message_bytes_max: usize) -> SerialConfig {
    port.set_timeout(Duration::from_millis(5)).unwrap();
    let mut port = Some(port);
    SerialConfig {
        name: "pty".to_owned(),
        bytes_per_s: NonZeroU32::new(300_000).unwrap(),
        session,
        message_bytes_max,
        open: Box::new(move || Ok(Box::new(port.take().ok_or(io::ErrorKind::NotFound)?))),
    }
}

/// Starts a thread that uploads `offer`. For each global model that the thread then receives, it sends the
/// model's body to `say`. The thread ends when `die` receives a message, or when the sender of `die` is dropped.
fn drone<T: Transport + Send + 'static>(
    mut transport: T,
    identity: Identity,
    offer: Offer,
    say: mpsc::Sender<(DeviceId, Vec<u8>)>,
    die: mpsc::Receiver<()>,
) -> JoinHandle<()> {
    thread::spawn(move || {
        let mut node = Node::new(identity, InboxLimits::default(), &[]);
        node.upload(offer);
        let begun = Instant::now();
        while die.try_recv() == Err(mpsc::TryRecvError::Empty) {
            if let Some(NodeEvent::Store { header, body }) =
                node.step(&mut transport, || begun.elapsed(), Duration::from_millis(20))
            {
                say.send((identity.device, body.to_vec())).unwrap();
                node.stored(header.into());
            }
        }
    })
}

#[test]
fn radio_and_network_share_a_mission() {
    let folder = tempfile::tempdir().unwrap();
    let broker = Broker::start(loopback()).unwrap();
    let address = broker_address(broker.address());
    let station =
        Station::start(folder.path(), address.clone(), ["by-radio", "by-net"], MergeSettings::default());
    let (say_line, lines) = mpsc::channel();
    let (air, ground_port) = TTYPort::pair().unwrap();
    let gateway = Gateway::start(
        Station::identity().site,
        Reach::plain(address.clone()),
        line(ground_port, 1, GATEWAY_MESSAGE_BYTES),
        move |event| drop(say_line.send(event)),
    );
    let (say, globals) = mpsc::channel();
    let (radio, net) = (identity(Role::Device, "by-radio"), identity(Role::Device, "by-net"));
    let serial = SerialTransport::start(line(air, 2, DEVICE_MESSAGE_BYTES));
    let (kill_radio, die) = mpsc::channel();
    let by_radio = drone(serial, radio, mergeable_offer("by-radio", 1500), say.clone(), die);
    let mqtt = MqttTransport::start(MqttConfig {
        broker: address,
        identity: net,
        will: None,
        tls: None,
        login: None,
    });
    let (kill_net, die) = mpsc::channel();
    let by_net = drone(mqtt, net, mergeable_offer("by-net", 1500), say, die);

    let mut got: Vec<_> = (0..2).map(|_| globals.recv_timeout(PATIENCE).unwrap()).collect();
    got.sort();
    assert_eq!([got[0].0, got[1].0], [net.device, radio.device]);
    assert!(got[0].1 == got[1].1, "both have the same global model");
    station.wait_for(|event| *event == ServiceEvent::Delivered);
    let on_line = GatewayEvent::OnLine { line: "pty".to_owned(), device: radio.device };
    assert_eq!(lines.recv_timeout(PATIENCE).unwrap(), on_line);

    kill_radio.send(()).unwrap();
    by_radio.join().unwrap();
    let off_line = lines.recv_timeout(PATIENCE).unwrap();
    assert!(matches!(&off_line, GatewayEvent::OffLine { reason } if reason.contains("pty")), "{off_line}");
    kill_net.send(()).unwrap();
    by_net.join().unwrap();
    assert!(station.finish());
    drop(gateway);
}

/// With the configuration of Mosquitto in `shared/docs`, the name in a certificate is the client id. So a device on a
/// radio needs its own certificate: with the aggregator's, it would take the place of the aggregator.
#[test]
fn a_device_on_a_radio_has_its_own_certificate() {
    let folder = tempfile::tempdir().unwrap();
    let authority = Authority::new(folder.path());
    let [ground, _] = ["aggregator", "by-radio"].map(|name| authority.client(name, name, 30));
    let docs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/docs");
    let read = |name: &str| fs::read_to_string(docs.join(name)).unwrap();
    fs::write(folder.path().join("cosurf.acl"), read("cosurf.acl").replace("quarry", "site")).unwrap();
    let settings = read("mosquitto.conf").replace("listener 8883", "listener PORT 127.0.0.1");
    let settings = ["/etc/mosquitto/certs", "/etc/mosquitto", "/var/lib/mosquitto"]
        .iter()
        .fold(settings, |settings, path| settings.replace(path, "FOLDER"));
    let Some(broker) = Mosquitto::start(folder.path(), &settings, true) else { return };
    let lines = Some((folder.path().to_owned(), ground.ca.clone()));
    let reach = Reach { tls: Some(tls(&ground)), lines, ..Reach::plain(broker.address.clone()) };
    let mut aggregator = MqttTransport::start(reach.config(Station::identity(), None));
    assert_eq!(aggregator.poll(PATIENCE), Some(TransportEvent::Connected));
    let (air, ground_port) = TTYPort::pair().unwrap();
    let (say_line, events) = mpsc::channel();
    let gateway = Gateway::start(
        Station::identity().site,
        reach,
        line(ground_port, 1, GATEWAY_MESSAGE_BYTES),
        move |event| drop(say_line.send(event)),
    );
    let radio = identity(Role::Device, "by-radio");
    let serial = SerialTransport::start(line(air, 2, DEVICE_MESSAGE_BYTES));
    let (say, _globals) = mpsc::channel();
    let (kill, die) = mpsc::channel();
    let drone = drone(serial, radio, mergeable_offer("by-radio", 100), say, die);
    let event = events.recv_timeout(PATIENCE).unwrap();
    assert_eq!(event, GatewayEvent::OnLine { line: "pty".to_owned(), device: radio.device });
    // The device is heard by the aggregator, which stays connected.
    let event = aggregator.poll(PATIENCE);
    assert!(
        matches!(&event, Some(TransportEvent::Incoming { topic, .. }) if topic.contains("/by-radio/")),
        "{event:?}"
    );
    drop(kill);
    drone.join().unwrap();
    drop(gateway);
}

/// Bad messages and many sessions give a few lines.
#[test]
fn attack_18_a_line_does_not_fill_the_log() {
    let broker = Broker::start(loopback()).unwrap();
    let (air, ground_port) = TTYPort::pair().unwrap();
    let (say_line, events) = mpsc::channel();
    let site = Station::identity().site;
    let reach = Reach::plain(broker_address(broker.address()));
    let gateway = Gateway::start(site, reach, line(ground_port, 1, GATEWAY_MESSAGE_BYTES), move |event| {
        drop(say_line.send(event));
    });
    let mut serial = SerialTransport::start(line(air, 2, DEVICE_MESSAGE_BYTES));
    let device = DeviceId::new("by-radio").unwrap();
    let mut say = |topic: Topic, payload: Vec<u8>| {
        let message = Outgoing { topic: topic.to_text(&site), payload, retain: false };
        while serial.publish(&message).is_err() {
            serial.poll(Duration::from_millis(5));
        }
    };
    for number in 0..100 {
        say(Topic::LocalHeader { device, model: ModelId(number) }, vec![1]);
    }
    for session in 0..20 {
        let state = Message::State(State { device, session, alive: true });
        say(Topic::State { device }, state.encode(&mut [0; 200]).unwrap().to_vec());
    }
    let end = Instant::now() + Duration::from_secs(5);
    while Instant::now() < end {
        serial.poll(Duration::from_millis(20));
    }
    let events: Vec<GatewayEvent> = events.try_iter().collect();
    assert!((1..=5).contains(&events.len()), "{events:?}");
    drop(gateway);
}
