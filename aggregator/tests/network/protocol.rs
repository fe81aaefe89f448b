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
    for (sub, publishing) in [(&["-q", "0"][..], &["-q", "1"][..]), (&["-V", "5"], &[]), (&[], &["-V", "5"])]
    {
        let topic = format!("t/{}{}", sub.len(), publishing.len());
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
