//! Attacks on the built-in broker, each a test by its number.

use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};
use std::sync::mpsc;
use std::thread::sleep;
use std::time::{Duration, Instant};

use cosurf_aggregator::broker::{Broker, BrokerEvent, BrokerSettings, MEMORY_BYTES_MIN};
use cosurf_link::Role;
use cosurf_tests::offers::identity;

use crate::ground::{BOUND, Ground};
use crate::raw::{AN_HOUR, Hello, Raw, connect, publish, subscribe};
use crate::station::loopback;

/// MQTT 5's reason code "quota exceeded".
const QUOTA_EXCEEDED: u8 = 0x97;

/// The bound counts what the broker keeps; the allocator and the thread's own buffers come on top.
fn is_within_bound(bytes: u64) -> bool {
    bytes < BOUND + BOUND / 2
}

/// An honest client can still publish.
fn publishes(address: SocketAddr) -> bool {
    Raw::connect(address, "honest").publish("gs/v1/site/honest/state", &[1; 40], true) == 0
        || Raw::connect(address, "honest-2").publish("gs/v1/site/honest/state", &[1; 40], true) == 0x10
}

#[test]
#[cfg(target_os = "linux")]
fn attack_02_small_retained_messages() {
    let folder = tempfile::tempdir().unwrap();
    let ground = Ground::start(folder.path());
    let mut attacker = Raw::connect(ground.address, "attacker");
    let message = |number: usize| publish(&format!("t/{number}"), &[7; 8], 0, true, &[]);
    for batch in 0..40 {
        let bytes: Vec<u8> = (0..5000).flat_map(|number| message(batch * 5000 + number)).collect();
        attacker.send(&bytes);
    }
    // While the flood waited in a buffer, the attacker's oldest messages gave way: that is room for some more.
    let mut last = (0..5000).map(|number| attacker.publish(&format!("last/{number}"), &[7; 8], true));
    assert!(last.any(|code| code == QUOTA_EXCEEDED), "the attacker is not told");
    println!("200,000 retained messages take {} KiB", ground.taken() >> 10);
    assert!(is_within_bound(ground.taken()), "{} KiB", ground.taken() >> 10);
    assert!(publishes(ground.address), "an honest client is refused");
}

/// One read of 64 KiB does not stay in memory for one small message in it.
#[test]
#[cfg(target_os = "linux")]
fn attack_02_a_small_message_keeps_no_large_buffer() {
    let folder = tempfile::tempdir().unwrap();
    let ground = Ground::start(folder.path());
    let mut attacker = Raw::connect(ground.address, "attacker");
    for number in 0..1000 {
        let filler = publish("filler", &[0; 60_000], 0, false, &[]);
        attacker.send(&[filler, publish(&format!("t/{number}"), &[7; 8], 0, true, &[])].concat());
    }
    attacker.publish("t/last", &[7; 8], true);
    println!("1,000 small messages between large ones take {} KiB", ground.taken() >> 10);
    assert!(ground.taken() < 4 << 20, "{} KiB", ground.taken() >> 10);
}

#[test]
#[cfg(target_os = "linux")]
fn attack_02_messages_to_absent_sessions() {
    let folder = tempfile::tempdir().unwrap();
    let ground = Ground::start(folder.path());
    for number in 0..100 {
        let hello =
            Hello { id: &format!("ghost-{number}"), properties: &AN_HOUR, clean: false, ..Hello::default() };
        assert_eq!(Raw::hello(ground.address, &hello).0.subscribe("#"), 1);
    }
    let mut attacker = Raw::connect(ground.address, "attacker");
    attacker.give_up_after(Duration::from_secs(20));
    let message = publish("t", &[7; 8], 1, false, &[]);
    let batch: Vec<u8> = (0..200).flat_map(|_| message.clone()).collect();
    for _ in 0..100 {
        attacker.send(&batch);
        (0..200).for_each(|_| assert!(attacker.packet().is_some()));
    }
    println!("20,000 messages to 100 absent sessions take {} KiB", ground.taken() >> 10);
    assert!(is_within_bound(ground.taken()), "{} KiB", ground.taken() >> 10);
    assert!(publishes(ground.address), "an honest client is refused");
}

/// Whoever keeps the most loses first, so a device's few messages outlive a flood under many names.
#[test]
fn attack_02_the_heaviest_client_loses_its_oldest_messages() {
    let settings = BrokerSettings { memory_bytes: MEMORY_BYTES_MIN, ..BrokerSettings::default() };
    let (say, events) = mpsc::channel();
    let broker = Broker::start_with(loopback(), settings, move |event| drop(say.send(event))).unwrap();
    let mut honest = Raw::connect(broker.address(), "honest");
    assert!(honest.publish("honest", b"header", true) & 0x80 == 0);
    for attacker in 0..8 {
        let name = format!("attacker-{attacker}");
        let mut attacker = Raw::connect(broker.address(), &name);
        for number in 0..60 {
            attacker.publish(&format!("{name}/{number}"), &[7; 50_000], true);
        }
    }
    let event = events.recv_timeout(Duration::from_secs(10)).unwrap();
    assert!(matches!(event, BrokerEvent::MemoryFull { .. }), "{event:?}");
    assert!(event.to_string().contains("raise `broker_memory`"), "{event}");
    assert!(events.try_recv().is_err(), "the same event is told again");
    honest.send(&subscribe("honest"));
    assert_eq!(honest.message(), ("honest".to_owned(), b"header".to_vec()));
}

#[test]
#[cfg(target_os = "linux")]
fn attack_15_many_subscriptions_to_many_retained_messages() {
    let folder = tempfile::tempdir().unwrap();
    let ground = Ground::start(folder.path());
    let mut attacker = Raw::connect(ground.address, "attacker");
    let messages: Vec<u8> =
        (0..2000).flat_map(|number| publish(&format!("t/{number}"), &[7; 1000], 0, true, &[])).collect();
    attacker.send(&messages);
    attacker.publish("t/last", &[7; 8], true);
    let retained = ground.taken();
    attacker.give_up_after(Duration::from_secs(1));
    for _ in 0..600 {
        if !attacker.try_send(&subscribe("#")) {
            break;
        }
    }
    assert!(publishes(ground.address), "an honest client is refused");
    let more = ground.taken() - retained;
    println!("600 subscriptions take {} KiB more", more >> 10);
    assert!(more < 4 << 20, "{} KiB", more >> 10);
}

#[test]
fn attack_10_half_a_connect_does_not_hold_a_place() {
    let settings = BrokerSettings { clients_max: 8, ..BrokerSettings::default() };
    let broker = Broker::start_with(loopback(), settings, |_| ()).unwrap();
    let bytes = connect(&Hello { id: "slow", ..Hello::default() });
    let mut drips: Vec<Raw> = (0..100).map(|_| Raw::silent(broker.address())).collect();
    let begun = Instant::now();
    let mut last = drips.pop().unwrap();
    for byte in &bytes {
        drips.iter_mut().for_each(|drip| _ = drip.try_send(&[*byte]));
        if !last.try_send(&[*byte]) {
            break;
        }
        // Each honest client gets in at once, whatever the others do.
        let honest = Instant::now();
        Raw::connect(broker.address(), "honest");
        assert!(honest.elapsed() < Duration::from_secs(1), "{:?}", honest.elapsed());
        sleep(Duration::from_millis(400));
        if begun.elapsed() > Duration::from_secs(8) {
            break;
        }
    }
    // Each byte came within 5 seconds of the last one, CONNECT as a whole did not.
    assert!(last.packet().is_none(), "the connection is still open");
    assert!(begun.elapsed() < Duration::from_secs(7), "{:?}", begun.elapsed());
}

#[test]
fn attack_10_idle_strangers_give_way() {
    let settings = BrokerSettings { clients_max: 8, ..BrokerSettings::default() };
    let broker = Broker::start_with(loopback(), settings, |_| ()).unwrap();
    let stranger = |number: usize| {
        Raw::hello(
            broker.address(),
            &Hello { id: &format!("stranger-{number}"), keep_alive_s: 0, ..Hello::default() },
        )
    };
    let mut strangers: Vec<(Raw, u8)> = (0..8).map(stranger).collect();
    assert!(strangers.iter().all(|(_, code)| *code == 0));
    // One more of them is refused, a device that the service knows is not.
    assert_eq!(stranger(9).1, QUOTA_EXCEEDED);
    let known = identity(Role::Device, "known").client_id();
    broker.introducer()(known.clone());
    sleep(Duration::from_millis(50));
    let mut device = Raw::connect(broker.address(), &known);
    assert_eq!(strangers[0].0.farewell(), QUOTA_EXCEEDED);
    assert!(device.publish("t", b"x", false) & 0x80 == 0);
    // A part of the program gets in at its own door, and nobody else there.
    let house = broker.house();
    let at_house: SocketAddr = (Ipv4Addr::LOCALHOST, house.broker.port).into();
    let login = house.login.unwrap();
    let hello = Hello { id: "part", login: Some((&login.user, &login.password)), ..Hello::default() };
    assert_eq!(Raw::hello(at_house, &hello).1, 0);
    assert_eq!(Raw::hello(at_house, &Hello { id: "part", ..Hello::default() }).1, 0x87);
}

/// An address that holds many places gives them up to other addresses.
#[test]
#[cfg(target_os = "linux")]
fn attack_10_one_address_does_not_hold_all_places() {
    let settings = BrokerSettings { clients_max: 8, ..BrokerSettings::default() };
    // A connection to ::1 comes from another address than one to 127.0.0.1.
    let everywhere = SocketAddr::new(Ipv6Addr::UNSPECIFIED.into(), 0);
    let broker = Broker::start_with(everywhere, settings, |_| ()).unwrap();
    let port = broker.address().port();
    let (four, six): (SocketAddr, SocketAddr) =
        ((Ipv4Addr::LOCALHOST, port).into(), (Ipv6Addr::LOCALHOST, port).into());
    let mut attackers: Vec<Raw> =
        (0..8).map(|number| Raw::connect(four, &format!("attacker-{number}"))).collect();
    let mut device = Raw::connect(six, "device");
    assert!(device.publish("t", b"x", false) & 0x80 == 0);
    assert_eq!(attackers[0].farewell(), QUOTA_EXCEEDED);
}

#[test]
#[cfg(target_os = "linux")]
fn attack_10_a_client_takes_one_descriptor_and_no_thread() {
    let folder = tempfile::tempdir().unwrap();
    let ground = Ground::start(folder.path());
    let (files, threads) = (ground.count("fd"), ground.count("task"));
    let clients: Vec<Raw> =
        (0..200).map(|number| Raw::connect(ground.address, &format!("client-{number}"))).collect();
    let (more_files, more_threads) = (ground.count("fd") - files, ground.count("task") - threads);
    println!("200 clients: {more_files} files, {more_threads} threads, {} KiB", ground.taken() >> 10);
    assert!(more_files <= clients.len() && more_threads == 0, "{more_files} files, {more_threads} threads");
}

#[test]
fn attack_17_a_slow_subscriber_slows_nobody() {
    let (say, events) = mpsc::channel();
    let settings = BrokerSettings::default();
    let broker = Broker::start_with(loopback(), settings, move |event| drop(say.send(event))).unwrap();
    let mut slow = Raw::connect(broker.address(), "slow\u{1b}[31m");
    assert_eq!(slow.subscribe("#"), 1);
    let mut publisher = Raw::connect(broker.address(), "publisher");
    let begun = Instant::now();
    for _ in 0..600 {
        assert!(publisher.publish("t", &[7; 60_000], false) & 0x80 == 0);
    }
    println!("36 MB beside a slow subscriber: {:?}", begun.elapsed());
    assert!(begun.elapsed() < Duration::from_secs(3), "{:?}", begun.elapsed());
    let event = events.recv_timeout(Duration::from_secs(20)).unwrap();
    assert!(matches!(event, BrokerEvent::Slow { .. }), "{event:?}");
    assert!(event.to_string().contains("slow\\u{1b}[31m takes"), "{event}");
    assert_eq!(slow.farewell(), QUOTA_EXCEEDED);
}

#[test]
fn attack_16_topics_do_not_write_lines() {
    let folder = tempfile::tempdir().unwrap();
    let mut ground = Ground::start(folder.path());
    let topic = "gs/v1/site/x\nglobal model, revision 9\u{1b}[2J\u{9b}1m\u{202e}/state";
    Raw::connect(ground.address, "attacker").publish(topic, b"x", false);
    let lines = ground.lines_until("ignored");
    assert!(
        lines.iter().all(|line| !line.starts_with("global model") && !line.contains('\u{1b}')),
        "{lines:?}"
    );
    let shown = "gs/v1/site/x\\nglobal model, revision 9\\u{1b}[2J\\u{9b}1m\\u{202e}/state";
    assert!(lines.last().unwrap().contains(shown), "{lines:?}");
}
