//! What one participant may take of the built-in broker, under however many client ids.

use std::thread::sleep;
use std::time::{Duration, Instant};

use cosurf_aggregator::broker::{Broker, BrokerSettings, MEMORY_BYTES_MIN, Users};

use crate::access::users;
use crate::raw::{AN_HOUR, Hello, Raw};
use crate::station::loopback;

/// MQTT 5's reason code "quota exceeded".
const QUOTA_EXCEEDED: u8 = 0x97;
/// Client ids of `other`, who does not wish the others well.
const IDS: usize = 60;

fn guarded(settings: BrokerSettings) -> Broker {
    let folder = tempfile::tempdir().unwrap();
    let users = Some(Users::read(&users(folder.path())).unwrap());
    Broker::start_with(loopback(), BrokerSettings { users, ..settings }, |_| ()).unwrap()
}

/// A client of `drone`, who must not notice anything.
fn honest(broker: &Broker, id: &str) -> Raw {
    let hello = Hello { id, login: Some(("drone", "enord")), ..Hello::default() };
    let (raw, code) = Raw::hello(broker.address(), &hello);
    assert_eq!(code, 0, "{id} is refused");
    raw
}

fn hostile(broker: &Broker, number: usize, properties: &[u8]) -> Raw {
    let id = format!("z{number}");
    let hello =
        Hello { id: &id, login: Some(("other", "rehto")), properties, clean: false, ..Hello::default() };
    let (raw, code) = Raw::hello(broker.address(), &hello);
    assert_eq!(code, 0, "{id} is refused");
    raw
}

#[test]
fn attack_10_a_user_does_not_hold_all_places() {
    let broker = guarded(BrokerSettings { clients_max: 24, ..BrokerSettings::default() });
    let mut clients: Vec<Raw> = (0..IDS).map(|number| hostile(&broker, number, &[])).collect();
    assert_eq!(clients[0].farewell(), QUOTA_EXCEEDED);
    let mut drones: Vec<Raw> = (0..8).map(|number| honest(&broker, &format!("drone-{number}"))).collect();
    for drone in &mut drones {
        assert!(drone.publish("gs/v1/site/drone/state", b"x", false) & 0x80 == 0);
    }
    // The last of the user's clients are still connected.
    assert!(clients[IDS - 1].publish("gs/v1/site/other/state", b"x", false) & 0x80 == 0);
}

/// With a place for every user, and all of them taken by clients of one.
#[test]
fn attack_10_a_full_broker_has_a_place_for_another_user() {
    let broker = guarded(BrokerSettings { clients_max: 4, ..BrokerSettings::default() });
    let mut clients: Vec<Raw> = (0..4).map(|number| hostile(&broker, number, &[])).collect();
    let mut drones = [honest(&broker, "drone-0"), honest(&broker, "drone-1")];
    assert_eq!([clients[0].farewell(), clients[1].farewell()], [QUOTA_EXCEEDED; 2]);
    // Now both have the same share.
    let hello = Hello { id: "drone-2", login: Some(("drone", "enord")), ..Hello::default() };
    assert_eq!(Raw::hello(broker.address(), &hello).1, QUOTA_EXCEEDED);
    for drone in &mut drones {
        assert!(drone.publish("gs/v1/site/drone/state", b"x", false) & 0x80 == 0);
    }
}

#[test]
fn attack_02_a_user_leaves_few_sessions_and_filters() {
    let broker = guarded(BrokerSettings::default());
    let mut granted = 0;
    for number in 0..IDS {
        let mut client = hostile(&broker, number, &AN_HOUR);
        let codes = (0..32).map(|filter| client.subscribe(&format!("gs/v1/site/other/dn/{filter}")));
        granted += codes.filter(|code| *code == 1).count();
    }
    assert!(granted >= 128, "{granted}");
    let resumed = |number: usize| {
        let hello = Hello {
            id: &format!("z{number}"),
            login: Some(("other", "rehto")),
            properties: &AN_HOUR,
            clean: false,
            ..Hello::default()
        };
        Raw::resume(broker.address(), &hello).1
    };
    let kept: Vec<usize> = (0..IDS).rev().filter(|number| resumed(*number)).collect();
    assert!(kept.len() <= 32 && kept.contains(&(IDS - 1)), "{kept:?}");
    assert_eq!(honest(&broker, "drone").subscribe("gs/v1/site/drone/dn/#"), 1);
}

/// Whoever keeps the most loses first: a user, not one of its many clients.
#[test]
fn attack_02_a_user_fills_the_memory_under_many_names() {
    let broker = guarded(BrokerSettings { memory_bytes: MEMORY_BYTES_MIN, ..BrokerSettings::default() });
    let mut drone = honest(&broker, "drone");
    let chunk = [7; 60_000];
    for number in 0..40 {
        let topic = format!("gs/v1/site/drone/up/1/c/{number}");
        assert!(drone.publish(&topic, &chunk, true) & 0x80 == 0);
    }
    // No client keeps as much as the drone, all together keep six times as much as there is room for.
    let mut refused = 0;
    for client in 0..16 {
        let mut raw = hostile(&broker, client, &[]);
        for number in 0..30 {
            let topic = format!("gs/v1/site/other/up/{client}/c/{number}");
            refused += usize::from(raw.publish(&topic, &chunk, true) == QUOTA_EXCEEDED);
        }
    }
    assert!(refused > 0, "the memory was never full");
    sleep(Duration::from_millis(300));
    assert!(drone.publish("gs/v1/site/drone/up/1/c/40", &chunk, true) & 0x80 == 0, "refused");
    drop(drone);
    let mut house = Raw::hello(
        (std::net::Ipv4Addr::LOCALHOST, broker.house().broker.port).into(),
        &Hello {
            id: "part",
            login: broker.house().login.as_ref().map(|login| (login.user.as_str(), login.password.as_str())),
            ..Hello::default()
        },
    )
    .0;
    house.subscribe("gs/v1/site/drone/up/#");
    let kept = (0..41).map(|_| house.message().0).collect::<std::collections::BTreeSet<_>>();
    assert_eq!(kept.len(), 41, "messages of the drone are lost");
}

/// Packets that take long to handle hold up those who send them, and nobody else: here each message is compared with
/// thousands of filters that differ from its topic at the last level only.
#[test]
fn attack_17_a_flood_of_slow_messages_slows_nobody() {
    let broker = Broker::start(loopback()).unwrap();
    let mut attackers: Vec<Raw> =
        (0..120).map(|number| Raw::connect(broker.address(), &format!("attacker-{number}"))).collect();
    let mut filters = (0..1 << 12).map(|number| {
        let levels = (0..12).map(|bit| if number >> bit & 1 == 0 { "+" } else { "a" });
        levels.chain(["b"]).collect::<Vec<_>>().join("/")
    });
    for attacker in &mut attackers {
        filters.by_ref().take(32).for_each(|filter| assert_eq!(attacker.subscribe(&filter), 1));
        attacker.give_up_after(Duration::from_millis(20));
    }
    let slow = crate::raw::publish(&["a"; 13].join("/"), b"x", 0, false, &[]);
    let flood = slow.repeat(100_000 / slow.len());
    let known = "known";
    broker.introducer()(known.to_owned());
    let mut device = Raw::connect(broker.address(), known);
    let mut slowest = Duration::ZERO;
    for _ in 0..4 {
        attackers.iter_mut().for_each(|attacker| _ = attacker.try_send(&flood));
        let begun = Instant::now();
        assert!(device.publish("gs/v1/site/known/state", b"x", false) & 0x80 == 0);
        slowest = slowest.max(begun.elapsed());
    }
    println!("slowest answer to a known device beside a flood: {slowest:?}");
    assert!(slowest < Duration::from_secs(1), "{slowest:?}");
}
