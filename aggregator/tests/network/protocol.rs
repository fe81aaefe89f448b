//! Parts of MQTT 5 and MQTT 3.1.1, with raw bytes and with the clients of Mosquitto.

use std::io::{BufRead, BufReader};
use std::net::SocketAddr;
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::Duration;

use cosurf_aggregator::broker::Broker;
use cosurf_tests::skips::skip;

use crate::raw::{AN_HOUR, Hello, Raw, publish, subscribe};
use crate::station::loopback;

const SECOND: Duration = Duration::from_secs(1);

/// A client that has a last will with a delay of a second.
fn mortal(address: SocketAddr) -> (Raw, bool) {
    let will: Option<(&[u8], &str, &[u8])> = Some((&[0x18, 0, 0, 0, 1], "will", b"gone"));
    Raw::resume(
        address,
        &Hello { id: "mortal", properties: &AN_HOUR, clean: false, will, ..Hello::default() },
    )
}

#[test]
fn a_last_will_waits_for_its_delay() {
    let broker = Broker::start(loopback()).unwrap();
    let mut heir = Raw::connect(broker.address(), "heir");
    heir.subscribe("will");
    drop(mortal(broker.address()));
    assert!(heir.is_silent_for(SECOND / 2), "the will is early");
    // A client that comes back in time has not died.
    let (again, had_session) = mortal(broker.address());
    assert!(had_session && heir.is_silent_for(SECOND * 3 / 2));
    drop(again);
    assert_eq!(heir.message(), ("will".to_owned(), b"gone".to_vec()));
}

#[test]
fn messages_expire() {
    let broker = Broker::start(loopback()).unwrap();
    let mut client = Raw::connect(broker.address(), "client");
    for (topic, seconds) in [("short", 1), ("long", 100)] {
        client.send(&publish(topic, b"x", 0, true, &[2, 0, 0, 0, seconds]));
    }
    let read = |id: &str| {
        let mut reader = Raw::connect(broker.address(), id);
        reader.send(&subscribe("#"));
        reader
    };
    let mut early = read("early");
    let topics = [early.message().0, early.message().0];
    assert_eq!(topics, ["long", "short"]);
    sleep(SECOND * 3 / 2);
    let mut late = read("late");
    assert_eq!(late.message().0, "long");
    assert!(late.is_silent_for(SECOND / 5), "an expired message is delivered");
    // A reader learns how much time is left.
    let mut reader = Raw::connect(broker.address(), "reader");
    reader.send(&subscribe("long"));
    let left = loop {
        if let (kind, body) = reader.packet().unwrap()
            && kind >> 4 == 3
        {
            let properties = body[6 + usize::from(kind & 6 != 0) * 2..].to_vec();
            break properties[properties.len() - 2];
        }
    };
    assert!((90..100).contains(&left), "{left} s are left");
}

#[test]
fn a_client_may_end_its_session_as_it_leaves() {
    let broker = Broker::start(loopback()).unwrap();
    let hello = Hello { id: "client", properties: &AN_HOUR, clean: false, ..Hello::default() };
    let (mut client, _) = Raw::resume(broker.address(), &hello);
    client.subscribe("a");
    client.send(&[0xE0, 0]);
    let (mut client, had_session) = Raw::resume(broker.address(), &hello);
    assert!(had_session, "the session is lost");
    client.send(&[0xE0, 7, 0, 5, 0x11, 0, 0, 0, 0]);
    sleep(SECOND / 10);
    assert!(!Raw::resume(broker.address(), &hello).1, "the session has outlived its end");
    // A session that ends with its connection cannot be prolonged as the client leaves.
    let (mut short, _) = Raw::resume(broker.address(), &Hello { id: "short", ..Hello::default() });
    short.send(&[0xE0, 7, 0, 5, 0x11, 0, 0, 0, 9]);
    assert_eq!(short.farewell(), 0x82);
}

/// The bytes of PUBLISH with QoS 2.
fn exactly_once(topic: &str, payload: &[u8], id: u8, is_copy: bool) -> Vec<u8> {
    let mut bytes = publish(topic, payload, 1, false, &[]);
    bytes[0] = 0x34 | u8::from(is_copy) << 3;
    bytes[2 + 2 + topic.len() + 1] = id;
    bytes
}

/// The bytes of SUBSCRIBE with properties.
fn subscribe_with(filter: &str, qos: u8, properties: &[u8]) -> Vec<u8> {
    let length = 2 + 1 + properties.len() + 2 + filter.len() + 1;
    let head = [0x82, length as u8, 0, 1, properties.len() as u8];
    [&head, properties, &[0, filter.len() as u8], filter.as_bytes(), &[qos]].concat()
}

fn subscribed(client: &mut Raw, filter: &str, qos: u8, properties: &[u8]) -> u8 {
    client.send(&subscribe_with(filter, qos, properties));
    let (kind, body) = client.packet().unwrap();
    assert_eq!(kind, 0x90);
    body[3]
}

#[test]
fn a_message_of_qos_2_arrives_once() {
    let broker = Broker::start(loopback()).unwrap();
    let keeper = Hello { id: "keeper", properties: &AN_HOUR, clean: false, ..Hello::default() };
    let (mut reader, _) = Raw::resume(broker.address(), &keeper);
    assert_eq!(subscribed(&mut reader, "a", 2, &[]), 2, "QoS 2 is not granted");
    // A client that comes back before the end of the handshake sends its message again.
    let sending = Hello { id: "writer", properties: &AN_HOUR, clean: false, ..Hello::default() };
    let (mut writer, _) = Raw::resume(broker.address(), &sending);
    writer.send(&exactly_once("a", b"x", 7, false));
    assert_eq!(writer.packet().unwrap(), (0x50, vec![0, 7]));
    let (mut writer, had_session) = Raw::resume(broker.address(), &sending);
    assert!(had_session);
    writer.send(&exactly_once("a", b"x", 7, true));
    assert_eq!(writer.packet().unwrap(), (0x50, vec![0, 7]));
    for answer in [vec![0, 7], vec![0, 7, 0x92, 0]] {
        writer.send(&[0x62, 2, 0, 7]);
        assert_eq!(writer.packet().unwrap(), (0x70, answer));
    }
    // The reader gets the message again until it has taken it, and then the release until it has finished.
    let (first, _) = reader.packet().unwrap();
    assert_eq!(first & 0x0E, 4);
    assert!(reader.is_silent_for(SECOND / 5), "the copy is delivered");
    let (mut reader, _) = Raw::resume(broker.address(), &keeper);
    let (again, body) = reader.packet().unwrap();
    let id = [body[3], body[4]];
    assert_eq!((again & 0x0E, body.last()), (0x0C, Some(&b'x')));
    reader.send(&[0x50, 2, id[0], id[1]]);
    assert_eq!(reader.packet().unwrap(), (0x62, id.to_vec()));
    let (mut reader, _) = Raw::resume(broker.address(), &keeper);
    assert_eq!(reader.packet().unwrap(), (0x62, id.to_vec()));
    reader.send(&[0x70, 2, id[0], id[1]]);
    reader.send(&[0xC0, 0]);
    assert_eq!(reader.packet().unwrap().0, 0xD0);
    let (mut reader, _) = Raw::resume(broker.address(), &keeper);
    assert!(reader.is_silent_for(SECOND / 5), "the handshake does not end");
    reader.send(&[0x50, 2, 0, 99]);
    assert_eq!(reader.packet().unwrap(), (0x62, vec![0, 99, 0x92, 0]));
}

#[test]
fn messages_of_qos_2_that_are_not_released_are_bounded() {
    let broker = Broker::start(loopback()).unwrap();
    let mut writer = Raw::connect(broker.address(), "writer");
    for id in 1..=64 {
        writer.send(&exactly_once("a", b"x", id, false));
    }
    writer.send(&exactly_once("a", b"x", 65, false));
    assert_eq!(writer.farewell(), 0x93);
}

#[test]
fn messages_carry_the_numbers_of_the_subscriptions() {
    let broker = Broker::start(loopback()).unwrap();
    let mut reader = Raw::connect(broker.address(), "reader");
    for (filter, number) in [("a/b", 2), ("a/#", 3), ("c", 4)] {
        assert_eq!(subscribed(&mut reader, filter, 0, &[0x0B, number]), 0);
    }
    Raw::connect(broker.address(), "writer").publish("a/b", b"x", false);
    let (kind, body) = reader.packet().unwrap();
    assert_eq!((kind >> 4, &body[5..]), (3, &[4, 0x0B, 2, 0x0B, 3, b'x'][..]));
    reader.send(&subscribe_with("d", 0, &[0x0B, 0]));
    assert_eq!(reader.farewell(), 0x82);
}

#[test]
fn clients_with_a_shared_subscription_get_each_message_once() {
    let broker = Broker::start(loopback()).unwrap();
    let mut readers = ["one", "two"].map(|id| Raw::connect(broker.address(), id));
    for reader in &mut readers {
        assert_eq!(subscribed(reader, "$share/team/t/+", 1, &[]), 1);
    }
    for bad in ["$share/team", "$share//t", "$share/+/t"] {
        assert_eq!(subscribed(&mut readers[0], bad, 1, &[]), 0x8F, "{bad}");
    }
    let mut writer = Raw::connect(broker.address(), "writer");
    for number in 0..10 {
        writer.publish("t/a", &[number], false);
    }
    let [one, two] = readers;
    let mut both = [one, two].map(|mut reader| {
        let mine: Vec<u8> = (0..5).map(|_| reader.message().1[0]).collect();
        assert!(reader.is_silent_for(SECOND / 5), "more than its share");
        mine
    });
    both.sort();
    let mut all = both.concat();
    all.sort_unstable();
    assert_eq!(all, (0..10).collect::<Vec<u8>>());
    let mut one = Raw::connect(broker.address(), "one");
    assert_eq!(subscribed(&mut one, "$share/team/t/+", 1, &[]), 1);
    // Once a client has left, its share of the messages goes to the clients that stay.
    for number in 0..4 {
        writer.publish("t/a", &[number], false);
        assert_eq!(one.message().1, [number]);
    }
}

/// Starts a client of Mosquitto; `None` if it is not installed.
fn start(program: &str, port: u16, arguments: &[&str]) -> Option<Child> {
    let mut command = Command::new(program);
    command.args(["-h", "127.0.0.1", "-p", &port.to_string()]).args(arguments);
    let child = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().ok();
    if child.is_none() {
        skip("REQUIRE_MOSQUITTO", format!("{program} is not installed"));
    }
    child
}

fn read_line(child: &mut Child) -> String {
    let mut line = String::new();
    BufReader::new(child.stdout.as_mut().unwrap()).read_line(&mut line).unwrap();
    line.trim_end().to_owned()
}

#[test]
fn the_clients_of_mosquitto_work_with_their_defaults() {
    let broker = Broker::start(loopback()).unwrap();
    let port = broker.address().port();
    let publish = |arguments: &[&str]| {
        let child = start("mosquitto_pub", port, arguments)?;
        let output = child.wait_with_output().unwrap();
        assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
        Some(())
    };
    // By default they speak MQTT 3.1.1; `-V 5` makes them speak MQTT 5.
    for (number, (sub, publishing)) in [
        (&["-q", "0"][..], &["-q", "1"][..]),
        (&["-V", "5"], &[]),
        (&[], &["-V", "5"]),
        (&["-q", "2"], &["-q", "2"]),
        (&["-q", "2", "-V", "5"], &["-q", "2", "-V", "5"]),
    ]
    .into_iter()
    .enumerate()
    {
        let topic = format!("t/{number}");
        let text = format!("{sub:?} {publishing:?}");
        if publish(&[&["-r", "-t", &topic, "-m", &text], publishing].concat()).is_none() {
            return;
        }
        let mut reader =
            start("mosquitto_sub", port, &[&["-t", "t/#", "-C", "1", "-W", "10"], sub].concat()).unwrap();
        assert_eq!(read_line(&mut reader), text);
        assert!(reader.wait().unwrap().success());
        publish(&["-r", "-t", &topic, "-n"]);
    }
}

#[test]
fn a_session_of_mqtt_3_1_1_waits_for_its_client() {
    let broker = Broker::start(loopback()).unwrap();
    let port = broker.address().port();
    let subscriber = ["-t", "a", "-q", "1", "-c", "-i", "keeper", "-W", "10"];
    let Some(mut first) = start("mosquitto_sub", port, &[&subscriber[..], &["-E"]].concat()) else { return };
    assert!(first.wait().unwrap().success());
    let mut publisher = start("mosquitto_pub", port, &["-t", "a", "-m", "kept", "-q", "1"]).unwrap();
    assert!(publisher.wait().unwrap().success());
    let mut second = start("mosquitto_sub", port, &[&subscriber[..], &["-C", "1"]].concat()).unwrap();
    assert_eq!(read_line(&mut second), "kept");
    // The last will of a client that is killed is published.
    let mut heir = start("mosquitto_sub", port, &["-t", "will", "-C", "1", "-W", "10"]).unwrap();
    let will = ["-t", "none", "--will-topic", "will", "--will-payload", "gone"];
    let mut mortal = start("mosquitto_sub", port, &will).unwrap();
    sleep(SECOND / 2);
    mortal.kill().unwrap();
    mortal.wait().unwrap();
    assert_eq!(read_line(&mut heir), "gone");
}

/// Bytes that look like random ones, the same in every run.
struct Noise(u64);

impl Noise {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }
}

/// One thread serves everybody, so no packet may end it.
#[test]
fn damaged_packets_end_only_their_own_connection() {
    let broker = Broker::start(loopback()).unwrap();
    let mut noise = Noise(7);
    let hello =
        crate::raw::connect(&Hello { id: "é", will: Some((&[1, 1], "é", b"x")), ..Hello::default() });
    let packets = [
        publish("é/ü", b"payload", 1, true, &[2, 0, 0, 0, 9, 38, 0, 1, b'k', 0, 1, b'v']),
        subscribe("é/+"),
        vec![0xA2, 7, 0, 1, 0, 0, 2, 0xC3, 0xA9],
        vec![0x40, 4, 0, 1, 0, 0],
        vec![0xE0, 7, 4, 5, 0x11, 0, 0, 0, 9],
        vec![0xC0, 0],
        vec![0xF0, 2, 0, 0],
        hello.clone(),
    ];
    for round in 0..4000 {
        let mut bytes = if round % 4 == 0 { Vec::new() } else { hello.clone() };
        for _ in 0..1 + noise.next() % 4 {
            let mut packet = packets[noise.next() as usize % packets.len()].clone();
            for _ in 0..noise.next() % 4 {
                let place = noise.next() as usize % packet.len();
                packet[place] = noise.next() as u8;
            }
            packet.truncate(packet.len() - noise.next() as usize % 2);
            bytes.extend(packet);
        }
        if round % 2 == 1 {
            // MQTT 3.1.1
            if let Some(level) = bytes.get_mut(8) {
                *level = 4;
            }
        }
        Raw::silent(broker.address()).try_send(&bytes);
        // Waits for the broker now and then, or the system drops connections that it has not accepted.
        if round % 50 == 0 {
            Raw::connect(broker.address(), "patient");
        }
    }
    let mut honest = Raw::connect(broker.address(), "honest");
    honest.subscribe("honest");
    honest.send(&publish("honest", b"x", 0, false, &[]));
    assert_eq!(honest.message(), ("honest".to_owned(), b"x".to_vec()));
}
