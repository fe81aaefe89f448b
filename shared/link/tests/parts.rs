//! The part of an upload that has arrived can be decoded to a usable model.
#![allow(clippy::unwrap_used)]

use std::time::Duration;

use cosurf_link::inbox::Inbox;
use cosurf_link::{Credentials, InboxLimits, Model, ModelKey, Offer, Role, SecretKey, Trusted};
use cosurf_tests::offers::{identity, offer};
use cosurf_wire::{Chunk, DeviceId, ModelHeader, ModelKind, Topic};

const NOW: Duration = Duration::ZERO;

fn inbox() -> Inbox {
    Inbox::new(identity(Role::Aggregator, "ground"), InboxLimits::default(), &[])
}

/// Sends all chunks but the last, and returns the partial model after each chunk, if there is one.
fn parts(mut inbox: Inbox, Offer { header, body }: &Offer) -> Vec<Model> {
    let ModelHeader { device, model, .. } = *header;
    inbox.on_header(NOW, &Topic::LocalHeader { device, model }, *header, 1);
    assert_eq!(inbox.unfinished().count(), 1);
    let mut take = |index| {
        let range = header.chunk_range(index).unwrap();
        let payload = &body[range.start as usize..range.end as usize];
        let topic = Topic::LocalChunk { device, model, index };
        assert_eq!(inbox.on_chunk(NOW, &topic, &Chunk { device, model, index, payload }), None);
        inbox.part(ModelKey::from(header)).map(|(_, part)| part)
    };
    (0..header.chunks() - 1).filter_map(&mut take).collect()
}

#[test]
fn a_part_grows_with_every_layer() {
    let offer = offer("drone", 1, ModelKind::Local, 1, 4000, 1024);
    let splats: Vec<usize> = parts(inbox(), &offer).iter().map(|part| part.splats.len()).collect();
    assert!(splats.is_sorted() && splats[0] > 0, "{splats:?}");
    assert!(splats[0] <= 1000 && splats.contains(&2000), "{splats:?}");
    assert_eq!(inbox().part(ModelKey::from(&offer.header)), None, "never announced");
}

#[test]
fn a_body_that_differs_from_its_header_gives_no_part() {
    let sane = offer("drone", 1, ModelKind::Local, 1, 4000, 1024);
    let lying = Offer { header: ModelHeader { splats: 100, ..sane.header }, ..sane };
    assert_eq!(parts(inbox(), &lying), []);
}

#[test]
fn a_model_that_must_be_signed_gives_no_part_before_it_is_whole() {
    let key = SecretKey::new(&[1; 32]);
    let list = key.public_line(&DeviceId::new("drone").unwrap());
    let signed = offer("drone", 1, ModelKind::Local, 1, 4000, 1024);
    let mut inbox = inbox();
    inbox.set_credentials(Credentials {
        trusted: Some(Trusted::parse(&list).unwrap()),
        ..Credentials::default()
    });
    assert_eq!(parts(inbox, &signed), []);
}
