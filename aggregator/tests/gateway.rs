//! A device by radio and a device by network in one mission: the service knows no difference.
#![cfg(unix)]
#![allow(clippy::unwrap_used)]

#[path = "../../shared/link/tests/common/mod.rs"]
mod common;

use std::io;
use std::num::NonZeroU32;
use std::ops::ControlFlow;
use std::sync::mpsc;
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use common::{credible, identity};
use cosurf_aggregator::broker::Broker;
use cosurf_aggregator::gateway::{Gateway, GatewayEvent};
use cosurf_aggregator::merge::MergeSettings;
use cosurf_aggregator::service::{Command, Expected, Service, ServiceConfig, ServiceEvent};
use cosurf_link::serial::{DEVICE_MESSAGE_BYTES, GATEWAY_MESSAGE_BYTES};
use cosurf_link::{
    BrokerAddress, Identity, InboxLimits, MqttConfig, MqttTransport, Node, NodeEvent, Offer, Role,
    SerialConfig, SerialTransport, Transport,
};
use cosurf_wire::DeviceId;
use serialport::{SerialPort, TTYPort};

const PATIENCE: Duration = Duration::from_secs(60);

/// One end of a cable of 300 kB/s.
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

/// Uploads, waits for the global model and says its bytes; then lives on until told to die.
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
    let broker = Broker::start(([127, 0, 0, 1], 0).into()).unwrap();
    let address = BrokerAddress {
        host: broker.address().ip().to_string(),
        port: broker.address().port(),
        is_tls: false,
    };
    let (events, heard) = mpsc::channel();
    let (say_line, lines) = mpsc::channel();
    let (commands, orders) = mpsc::channel();
    let ground = identity(Role::Aggregator, "ground");
    let service = Service::open(ServiceConfig {
        identity: ground,
        folder: folder.path().to_owned(),
        limits: InboxLimits::default(),
        expected: Expected::Devices(["by-radio", "by-net"].map(|name| DeviceId::new(name).unwrap()).into()),
        merge: MergeSettings::default(),
        threads: 1,
    })
    .unwrap();
    let to = address.clone();
    let station = thread::spawn(move || {
        let begun = Instant::now();
        let mut transport = MqttTransport::start(MqttConfig { broker: to, identity: ground, tls: None });
        service.run(
            &mut transport,
            || begun.elapsed(),
            &orders,
            |event| {
                let _ = events.send(event);
                ControlFlow::Continue(())
            },
        )
    });

    let (air, ground_port) = TTYPort::pair().unwrap();
    let gateway = Gateway::start(
        ground.site,
        address.clone(),
        None,
        line(ground_port, 1, GATEWAY_MESSAGE_BYTES),
        move |event| drop(say_line.send(event)),
    );
    let (say, globals) = mpsc::channel();
    let (radio, net) = (identity(Role::Device, "by-radio"), identity(Role::Device, "by-net"));
    let serial = SerialTransport::start(line(air, 2, DEVICE_MESSAGE_BYTES));
    let (kill_radio, die) = mpsc::channel();
    let by_radio = drone(serial, radio, credible("by-radio", 1500), say.clone(), die);
    let mqtt = MqttTransport::start(MqttConfig { broker: address, identity: net, tls: None });
    let (kill_net, die) = mpsc::channel();
    let by_net = drone(mqtt, net, credible("by-net", 1500), say, die);

    let mut got: Vec<_> = (0..2).map(|_| globals.recv_timeout(PATIENCE).unwrap()).collect();
    got.sort();
    assert_eq!([got[0].0, got[1].0], [net.device, radio.device]);
    assert!(got[0].1 == got[1].1, "both have the same global model");
    let delivered = || heard.recv_timeout(PATIENCE).unwrap() == ServiceEvent::Delivered;
    while !delivered() {}
    let on_line = GatewayEvent::OnLine { line: "pty".to_owned(), device: radio.device };
    assert_eq!(lines.recv_timeout(PATIENCE).unwrap(), on_line);

    kill_radio.send(()).unwrap();
    by_radio.join().unwrap();
    let off_line = lines.recv_timeout(PATIENCE).unwrap();
    assert!(matches!(&off_line, GatewayEvent::OffLine { reason } if reason.contains("pty")), "{off_line}");
    kill_net.send(()).unwrap();
    by_net.join().unwrap();
    commands.send(Command::Finish).unwrap();
    assert!(station.join().unwrap().is_some());
    drop(gateway);
}
