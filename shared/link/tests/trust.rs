//! Signatures: a model is refused with a reason if its device is unknown, its key is revoked, or it was
//! changed or replayed.
#![allow(clippy::unwrap_used)]

use std::time::Duration;

use cosurf_link::inbox::{Inbox, InboxEvent};
use cosurf_link::{Credentials, Faults, InboxLimits, MemoryNetwork, NodeEvent, Role, SecretKey, Trusted};
use cosurf_tests::fleet::{Member, run_until};
use cosurf_tests::offers::{identity, offer};
use cosurf_wire::{DeviceId, FrameId, ModelHeader, ModelId, ModelKind, RefusalReason, SiteId, Topic};

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

/// The header of the drone's model `number`, signed with `key`.
fn signed(number: u64, key: u8) -> ModelHeader {
    offer("drone", number, ModelKind::Local, number, 30, 1024)
        .with_credentials(&site(), &credentials(key))
        .header
}

/// Why an aggregator that has `list` as its keys and `stored` as its models refuses a header; `None` if it
/// accepts the header.
fn verdict(list: &str, stored: &[ModelHeader], header: ModelHeader) -> Option<RefusalReason> {
    let mut inbox = Inbox::new(identity(Role::Aggregator, "ground"), InboxLimits::default(), stored);
    inbox.set_credentials(Credentials {
        trusted: Some(Trusted::parse(list).unwrap()),
        ..Credentials::default()
    });
    let topic = Topic::LocalHeader { device: header.device, model: header.model };
    match inbox.on_header(Duration::ZERO, &topic, header) {
        Some(InboxEvent::Refused(_, reason)) => Some(reason),
        _ => None,
    }
}

#[test]
fn unknown_revoked_changed_and_replayed_models_are_refused() {
    let list = format!("# the fleet\n{}\n", line(1));
    let sane = signed(5, 1);
    assert_eq!(verdict(&list, &[], sane), None);
    assert_eq!(verdict("", &[], sane), Some(RefusalReason::UnknownDevice));
    assert_eq!(verdict(&list, &[], signed(5, 2)), Some(RefusalReason::BadSignature));
    assert_eq!(
        verdict(&list, &[], ModelHeader { signature: None, ..sane }),
        Some(RefusalReason::BadSignature)
    );
    let changed = ModelHeader { views: sane.views + 1, ..sane };
    assert_eq!(verdict(&list, &[], changed), Some(RefusalReason::BadSignature));
    assert_eq!(verdict(&format!("revoked {}", line(1)), &[], sane), Some(RefusalReason::Revoked));
    let both = format!("{}\nrevoked {}", line(1), line(1));
    assert_eq!(verdict(&both, &[], sane), Some(RefusalReason::Revoked));
    assert_eq!(verdict(&list, &[signed(6, 1)], sane), Some(RefusalReason::Replayed));
    // A drone offers a stored model again if the acknowledgement was lost.
    assert_eq!(verdict(&list, &[signed(6, 1), sane], sane), None);
    assert_eq!(verdict(&list, &[signed(4, 1)], sane), None);
}

#[test]
fn a_device_changes_its_key_while_both_are_listed() {
    let list = format!("{}\n{}", line(1), line(2));
    assert_eq!(verdict(&list, &[], signed(5, 1)), None);
    assert_eq!(verdict(&list, &[], signed(6, 2)), None);
    let after = format!("revoked {}\n{}", line(1), line(2));
    assert_eq!(verdict(&after, &[], signed(7, 1)), Some(RefusalReason::Revoked));
    assert_eq!(verdict(&after, &[], signed(7, 2)), None);
}

#[test]
fn the_signature_holds_for_any_chunk_size() {
    let small = ModelHeader { chunk_bytes: 1000, ..signed(5, 1) };
    assert_eq!(verdict(&line(1), &[], small), None);
}

#[test]
fn another_frame_is_refused_without_a_list_of_keys_too() {
    let mut inbox = Inbox::new(identity(Role::Aggregator, "ground"), InboxLimits::default(), &[]);
    let elsewhere = Credentials { frame: FrameId::new("utm-33n").unwrap(), ..Credentials::default() };
    let header =
        offer("drone", 1, ModelKind::Local, 1, 30, 1024).with_credentials(&site(), &elsewhere).header;
    let topic = Topic::LocalHeader { device: device(), model: ModelId(1) };
    let said = inbox.on_header(Duration::ZERO, &topic, header);
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
    let said = inbox.on_header(Duration::ZERO, &topic, header);
    assert!(matches!(said, Some(InboxEvent::Refused(_, RefusalReason::TooLarge))), "{said:?}");
}

/// Both sides sign their models, over a network that loses and duplicates messages. An unknown device is told
/// why its model is refused.
#[test]
fn signed_models_arrive_and_those_of_unknown_devices_do_not() {
    let network = MemoryNetwork::new(3, Faults { loss: 0.1, duplication: 0.1, ..Faults::NONE });
    let mut drone = Member::new(&network, Role::Device, "drone", InboxLimits::default());
    drone.node.set_credentials(credentials(1));
    drone.node.upload(offer("drone", 1, ModelKind::Local, 1, 500, 2048));
    let mut stranger = Member::new(&network, Role::Device, "stranger", InboxLimits::default());
    stranger.node.set_credentials(credentials(9));
    stranger.node.upload(offer("stranger", 1, ModelKind::Local, 2, 500, 2048));
    let mut ground = Member::new(&network, Role::Aggregator, "ground", InboxLimits::default());
    let trusted = Some(Trusted::parse(&line(1)).unwrap());
    ground.node.set_credentials(Credentials { trusted, ..credentials(7) });
    let mut fleet = [drone, stranger, ground];
    let is_refused = |member: &Member| {
        let refused = |event: &NodeEvent| {
            matches!(event, NodeEvent::UploadRefused { reason: RefusalReason::UnknownDevice, .. })
        };
        member.events.iter().any(refused)
    };
    run_until(&network, &mut fleet, Duration::from_secs(60), |fleet| {
        !fleet[0].uploaded.is_empty() && is_refused(&fleet[1])
    });
    assert_eq!(fleet[2].disk.len(), 1);
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
