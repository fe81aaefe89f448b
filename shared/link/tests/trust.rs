//! Keys: a model whose device is unknown, whose key is revoked, or that was changed is met with silence. A replayed one is
//! refused.
#![allow(clippy::unwrap_used)]

use std::cell::Cell;
use std::time::Duration;

use cosurf_link::inbox::{Inbox, InboxEvent};
use cosurf_link::{
    Credentials, Faults, InboxLimits, MemoryNetwork, Node, NodeEvent, Role, SecretKey, Trusted,
};
use cosurf_tests::fleet::{Member, run_until};
use cosurf_tests::offers::{identity, offer};
use cosurf_tests::stranger::Stranger;
use cosurf_wire::{
    DeviceId, FrameId, Message, ModelHeader, ModelId, ModelKind, RefusalReason, SiteId, Topic,
};

fn site() -> SiteId {
    SiteId::new("site").unwrap()
}

fn device() -> DeviceId {
    DeviceId::new("drone").unwrap()
}

fn credentials(key: u8) -> Credentials {
    Credentials { key: Some(SecretKey::new(&[key; 32])), ..Credentials::default() }
}

fn line(key: u8) -> String {
    SecretKey::new(&[key; 32]).public_line(&device())
}

/// The header of the drone's model `number`.
fn header(number: u64) -> ModelHeader {
    offer("drone", number, ModelKind::Local, number, 30, 1024).header
}

/// What an aggregator does with a header.
#[derive(Debug, PartialEq)]
enum Verdict {
    Accepted,
    Refused(RefusalReason),
    /// It says nothing to the device, and counts the message.
    Silence,
}

/// What an aggregator that has `list` as its keys and `stored` as its models does with the header of the drone's model
/// `number`, signed with `key`, after `change`.
fn verdict(
    list: &str,
    stored: &[ModelHeader],
    number: u64,
    key: Option<u8>,
    change: impl Fn(Vec<u8>) -> Vec<u8>,
) -> Verdict {
    let network = MemoryNetwork::new(1, Faults::NONE);
    let mut drone = Member::new(&network, Role::Device, "drone", InboxLimits::default());
    drone.node.set_credentials(key.map(credentials).unwrap_or_default());
    drone.node.upload(offer("drone", number, ModelKind::Local, number, 30, 1024));
    drone.work(&network);
    let topic = Topic::LocalHeader { device: device(), model: ModelId(number) }.to_text(&site());
    let sealed = network.retained(&topic).unwrap();
    let network = MemoryNetwork::new(1, Faults::NONE);
    let mut ground = Member::new(&network, Role::Aggregator, "ground", InboxLimits::default());
    ground.node = Node::new(ground.identity, InboxLimits::default(), stored);
    let trusted = Some(Trusted::parse(list).unwrap());
    ground.node.set_credentials(Credentials { trusted, ..Credentials::default() });
    let mut stranger = Stranger::new(&network);
    ground.work(&network);
    stranger.say_bytes(&topic, change(sealed));
    ground.work(&network);
    stranger.listen();
    let told = ground.events.iter().find_map(|event| match event {
        NodeEvent::Refused { reason, .. } => Some(Verdict::Refused(*reason)),
        NodeEvent::Receiving(_) | NodeEvent::Known(_) => Some(Verdict::Accepted),
        _ => None,
    });
    let is_answered = stranger.heard.iter().any(|(topic, _)| topic.contains("/dn/"));
    assert_eq!(is_answered, told.is_some());
    assert!(told.is_some() || ground.node.forged() > 0, "{:?}", ground.events);
    told.unwrap_or(Verdict::Silence)
}

/// What happens to a header that arrives as it was sent.
fn unchanged(list: &str, stored: &[ModelHeader], number: u64, key: u8) -> Verdict {
    verdict(list, stored, number, Some(key), |sealed| sealed)
}

#[test]
fn unknown_revoked_and_changed_models_are_met_with_silence_and_replayed_ones_refused() {
    let list = format!("# the fleet\n{}\n", line(1));
    assert_eq!(unchanged(&list, &[], 5, 1), Verdict::Accepted);
    assert_eq!(unchanged("", &[], 5, 1), Verdict::Silence, "unknown");
    assert_eq!(unchanged(&list, &[], 5, 2), Verdict::Silence, "another key");
    assert_eq!(verdict(&list, &[], 5, None, |sealed| sealed), Verdict::Silence, "unsigned");
    let mut changed = 0;
    for place in 2..200 {
        let is_read = Cell::new(false);
        let change = |sealed: Vec<u8>| {
            let mut bytes = sealed[..sealed.len() - 4].to_vec();
            let place = place % bytes.len();
            bytes[place] ^= 1;
            bytes.extend(crc32fast::hash(&bytes).to_le_bytes());
            // What cannot be read is not counted as a forgery.
            is_read.set(matches!(Message::decode(&bytes), Ok(Message::Header(_))));
            if is_read.get() { bytes } else { sealed }
        };
        let said = verdict(&list, &[], 5, Some(1), change);
        assert_eq!(said, if is_read.get() { Verdict::Silence } else { Verdict::Accepted }, "byte {place}");
        changed += u32::from(is_read.get());
    }
    assert!(changed > 100, "{changed} changes could be read");
    assert_eq!(unchanged(&format!("revoked {}", line(1)), &[], 5, 1), Verdict::Silence);
    let both = format!("{}\nrevoked {}", line(1), line(1));
    assert_eq!(unchanged(&both, &[], 5, 1), Verdict::Silence);
    assert_eq!(unchanged(&list, &[header(6)], 5, 1), Verdict::Refused(RefusalReason::Replayed));
    // A drone offers a stored model again if the acknowledgement was lost.
    assert_eq!(unchanged(&list, &[header(6), header(5)], 5, 1), Verdict::Accepted);
    assert_eq!(unchanged(&list, &[header(4)], 5, 1), Verdict::Accepted);
}

#[test]
fn a_device_changes_its_key_while_both_are_listed() {
    let list = format!("{}\n{}", line(1), line(2));
    assert_eq!(unchanged(&list, &[], 5, 1), Verdict::Accepted);
    assert_eq!(unchanged(&list, &[], 6, 2), Verdict::Accepted);
    let after = format!("revoked {}\n{}", line(1), line(2));
    assert_eq!(unchanged(&after, &[], 7, 1), Verdict::Silence);
    assert_eq!(unchanged(&after, &[], 7, 2), Verdict::Accepted);
}

#[test]
fn another_frame_is_refused_without_a_list_of_keys_too() {
    let mut inbox = Inbox::new(identity(Role::Aggregator, "ground"), InboxLimits::default(), &[]);
    let header =
        offer("drone", 1, ModelKind::Local, 1, 30, 1024).in_frame(FrameId::new("utm-33n").unwrap()).header;
    let topic = Topic::LocalHeader { device: device(), model: ModelId(1) };
    let said = inbox.on_header(Duration::ZERO, &topic, header, 1);
    assert!(matches!(said, Some(InboxEvent::Refused(_, RefusalReason::WrongFrame))), "{said:?}");
}

/// The limit applies also to the unpacked size of a model, not only to its packed size.
#[test]
fn a_model_too_large_when_unpacked_is_refused_by_its_header() {
    let limits = InboxLimits { body_bytes_max: 100_000, total_bytes_max: 200_000, ..InboxLimits::default() };
    let mut inbox = Inbox::new(identity(Role::Aggregator, "ground"), limits, &[]);
    let header = offer("drone", 1, ModelKind::Local, 1, 2000, 1024).header;
    assert!(header.body_bytes < 100_000 && header.unpacked_bytes() > 100_000);
    let topic = Topic::LocalHeader { device: device(), model: ModelId(1) };
    let said = inbox.on_header(Duration::ZERO, &topic, header, 1);
    assert!(matches!(said, Some(InboxEvent::Refused(_, RefusalReason::TooLarge))), "{said:?}");
}

/// Both sides sign their messages, over a network that loses and duplicates them. An unknown device is told nothing.
#[test]
fn signed_models_arrive_and_those_of_unknown_devices_do_not() {
    let network = MemoryNetwork::new(3, Faults { loss: 0.1, duplication: 0.1, ..Faults::NONE });
    let ground_line = SecretKey::new(&[7; 32]).public_line(&DeviceId::new("ground").unwrap());
    let of_device =
        |key: u8| Credentials { trusted: Some(Trusted::parse(&ground_line).unwrap()), ..credentials(key) };
    let mut drone = Member::new(&network, Role::Device, "drone", InboxLimits::default());
    drone.node.set_credentials(of_device(1));
    drone.node.upload(offer("drone", 1, ModelKind::Local, 1, 500, 2048));
    let mut stranger = Member::new(&network, Role::Device, "stranger", InboxLimits::default());
    stranger.node.set_credentials(of_device(9));
    stranger.node.upload(offer("stranger", 1, ModelKind::Local, 2, 500, 2048));
    let mut ground = Member::new(&network, Role::Aggregator, "ground", InboxLimits::default());
    let trusted = Some(Trusted::parse(&line(1)).unwrap());
    ground.node.set_credentials(Credentials { trusted, ..credentials(7) });
    let mut fleet = [drone, stranger, ground];
    let is_unanswered =
        |member: &Member| member.events.iter().any(|event| matches!(event, NodeEvent::Unanswered { .. }));
    run_until(&network, &mut fleet, Duration::from_secs(60), |fleet| {
        !fleet[0].uploaded.is_empty() && is_unanswered(&fleet[1])
    });
    assert_eq!(fleet[2].disk.len(), 1);
    assert!(!is_unanswered(&fleet[0]));
    assert_eq!(fleet[0].node.forged(), 0);
}

#[test]
fn errors_name_the_line_of_the_list_and_keys_are_not_overwritten() {
    for (list, line) in [("drone 12", "line 1"), ("\nrevoke drone x", "line 2"), ("a/b 00", "line 1")] {
        assert!(Trusted::parse(list).unwrap_err().contains(line), "{list}");
    }
    let folder = std::env::temp_dir().join(format!("cosurf-key-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let path = folder.join("a.key");
    let key = SecretKey::new(&[3; 32]);
    key.write_new(&path).unwrap();
    assert_eq!(SecretKey::read(&path).unwrap().public_line(&device()), key.public_line(&device()));
    assert!(key.write_new(&path).unwrap_err().to_string().contains("not overwritten"));
    assert!(!format!("{key:?}").contains("0303"), "a secret key is not printed");
    std::fs::remove_dir_all(&folder).unwrap();
}
