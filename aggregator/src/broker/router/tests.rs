#![allow(clippy::unwrap_used)]
use bytes::Bytes;
use rumqttc::v5::mqttbytes::v5::{Connect, Filter, Subscribe, SubscribeReasonCode};

use super::super::access::Access;
use super::super::memory::Budget;
use super::super::packet::{Hello, Version};
use super::*;

const MIB: usize = 1 << 20;

fn router(memory_bytes: usize) -> Router {
    let access = Access { users: None, takes_certificates: false, site: None, house_password: String::new() };
    Router::new(100, Budget::new(memory_bytes), Arc::new(access))
}

/// Connects a client that subscribes to everything.
fn listen(router: &mut Router, link: usize, user: User, id: &str, now: Instant) {
    join(router, link, user, id, now);
    let filter = Filter::new("#", QoS::AtLeastOnce);
    router.subscribe(link, now, Subscribe { pkid: 1, filters: vec![filter], properties: None });
}

fn join(router: &mut Router, link: usize, user: User, id: &str, now: Instant) {
    let connect = Connect { keep_alive: 60, client_id: id.to_owned(), clean_start: true, properties: None };
    let hello = Hello { version: Version::V5, connect, will: None, login: None };
    assert_eq!(router.connect(link, now, &Client::new(user, id), hello), Ok(None));
}

fn message(bytes: usize) -> Publish {
    Publish { pkid: 1, ..Publish::new("t", QoS::AtLeastOnce, Bytes::from(vec![7; bytes]), None) }
}

/// The bytes that a client gets.
fn written(router: &mut Router, link: usize, now: Instant) -> usize {
    let mut out = BytesMut::new();
    router.write(link, now, usize::MAX, &mut out);
    out.len()
}

#[test]
fn a_publisher_waits_for_parts_of_this_program_only() {
    let now = Instant::now();
    for (user, expected) in [(User::House, Taken::Blocked), (User::Stranger, Taken::Queued)] {
        let mut router = router(64 * MIB);
        listen(&mut router, 1, user, "listener", now);
        join(&mut router, 2, User::Stranger, "publisher", now);
        // The queue holds 16 MiB.
        for _ in 0..16 {
            assert_eq!(router.receive(2, now, &message(MIB - 1024), false), Taken::Queued);
        }
        assert_eq!(router.receive(2, now, &message(MIB), false), expected);
        assert_eq!(router.receive(2, now, &message(MIB), true), Taken::Queued, "urgent");
        assert!(router.missed(1) > 0);
        assert!(written(&mut router, 1, now) > 15 * MIB);
        assert_eq!(router.receive(2, now, &message(MIB), false), Taken::Queued);
    }
}

#[test]
fn what_clients_keep_is_given_back() {
    let now = Instant::now();
    let mut router = router(64 * MIB);
    listen(&mut router, 1, User::Stranger, "listener", now);
    join(&mut router, 2, User::Stranger, "publisher", now);
    for link in [1, 2] {
        written(&mut router, link, now);
    }
    let before = router.budget.used();
    let retained = Publish { retain: true, ..message(MIB) };
    router.receive(2, now, &retained, false);
    // The queue and the retained message share the bytes.
    let used = router.budget.used() - before;
    assert!((MIB..MIB + 4096).contains(&used), "{used}");
    written(&mut router, 1, now);
    router.acknowledge(1, 1);
    router.receive(2, now, &Publish { payload: Bytes::new(), ..retained }, false);
    written(&mut router, 1, now);
    router.acknowledge(1, 2);
    written(&mut router, 2, now);
    assert_eq!(router.budget.used(), before);
    router.disconnect(1, now, true);
    router.disconnect(2, now, true);
    assert_eq!(router.budget.used(), 0);
}

#[test]
fn strangers_lose_their_messages_before_known_devices() {
    let now = Instant::now();
    let mut router = router(16 * MIB);
    router.know("known".to_owned());
    for (link, id, messages) in [(1, "known", 12), (2, "stranger", 2)] {
        join(&mut router, link, User::Stranger, id, now);
        for number in 0..messages {
            let topic = Bytes::from(format!("{id}/{number}"));
            router.receive(link, now, &Publish { topic, retain: true, ..message(MIB) }, false);
        }
    }
    join(&mut router, 3, User::Stranger, "third", now);
    for number in 0..2 {
        let topic = Bytes::from(format!("third/{number}"));
        router.receive(3, now, &Publish { topic, retain: true, ..message(MIB) }, false);
    }
    let kept: Vec<(&str, usize)> =
        router.retained.owners().map(|(owner, bytes)| (owner.id(), bytes / MIB)).collect();
    assert!(kept.contains(&("known", 12)), "{kept:?}");
    assert!(router.budget.used() <= 16 * MIB && router.take_lost() > 0);
}

#[test]
fn a_session_that_starts_anew_publishes_the_will_that_waits() {
    let now = Instant::now();
    let mut router = router(16 * MIB);
    listen(&mut router, 1, User::Stranger, "heir", now);
    written(&mut router, 1, now);
    join(&mut router, 2, User::Stranger, "mortal", now);
    let link = router.linked(2).unwrap().link.as_mut().unwrap();
    (link.will, link.will_delay_s, link.expiry_s) = (Some(message(9)), 60, 60);
    router.disconnect(2, now, false);
    router.tick(now + Duration::from_secs(59));
    assert_eq!(written(&mut router, 1, now), 0, "the will is early");
    join(&mut router, 3, User::Stranger, "mortal", now);
    assert!(written(&mut router, 1, now) > 9, "the will is lost");
}

/// Tries a filter of many levels, too.
#[test]
fn strangers_together_have_few_subscriptions() {
    let now = Instant::now();
    let mut router = router(64 * MIB);
    router.know("known".to_owned());
    let add = |router: &mut Router, client: &str, filter: String| {
        let filter = Subscription::new(Filter::new(filter, QoS::AtLeastOnce), None);
        router.subscribe_to(&Client::new(User::Stranger, client), now, filter)
    };
    let granted = SubscribeReasonCode::Success(QoS::AtLeastOnce);
    for client in 0..40 {
        let name = client.to_string();
        join(&mut router, client, User::Stranger, &name, now);
        if client == 0 {
            router.linked(0).unwrap().link.as_mut().unwrap().expiry_s = 60;
        }
        for filter in 0..32 {
            // 100 clients, 8 subscriptions for each.
            let expected = if client < 25 { granted } else { SubscribeReasonCode::QuotaExceeded };
            assert_eq!(add(&mut router, &name, filter.to_string()), expected, "{client} {filter}");
        }
    }
    assert_eq!(add(&mut router, "30", "a/".repeat(15) + "b"), SubscribeReasonCode::QuotaExceeded);
    assert_eq!(add(&mut router, "30", "a/".repeat(16) + "b"), SubscribeReasonCode::TopicFilterInvalid);
    join(&mut router, 50, User::Stranger, "known", now);
    assert_eq!(add(&mut router, "known", "a".to_owned()), granted);
    // The session that somebody left behind gives way.
    router.disconnect(0, now, true);
    assert_eq!(add(&mut router, "30", "a".to_owned()), granted);
    assert!(router.filters.matching("5").iter().all(|client| client.id() != "0"));
}
