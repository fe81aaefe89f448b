//! What has arrived of an upload that is not finished is a model already.
#![allow(clippy::unwrap_used)]

mod common;

use std::time::Duration;

use common::{identity, offer};
use cosurf_link::inbox::Inbox;
use cosurf_link::{Credentials, InboxLimits, Model, ModelKey, Offer, Role, SecretKey, Trusted};
use cosurf_wire::{Chunk, DeviceId, ModelHeader, ModelKind, SiteId, Topic};

const NOW: Duration = Duration::ZERO;

fn inbox() -> Inbox {
    Inbox::new(identity(Role::Aggregator, "ground"), InboxLimits::default(), &[])
}

/// What there is after every chunk but the last, but for nothing.
fn parts(mut inbox: Inbox, Offer { header, body }: &Offer) -> Vec<Model> {
    let ModelHeader { device, model, .. } = *header;
    inbox.on_header(NOW, &Topic::LocalHeader { device, model }, *header);
    assert_eq!(inbox.unfinished().count(), 1);
    let mut take = |index| {
        let range = header.chunk_range(index).unwrap();
        let payload = &body[range.start as usize..range.end as usize];
        let topic = Topic::LocalChunk { device, model, index };
        assert_eq!(inbox.on_chunk(NOW, &topic, &Chunk { device, model, index, payload }), None);
        inbox.part(ModelKey::from(header))
    };
    (0..header.chunks() - 1).filter_map(&mut take).collect()
}

#[test]
fn it_grows_with_every_layer() {
    let offer = offer("drone", 1, ModelKind::Local, 1, 4000, 1024);
    let splats: Vec<usize> = parts(inbox(), &offer).iter().map(|part| part.splats.len()).collect();
    assert!(splats.is_sorted() && splats[0] > 0, "{splats:?}");
    assert!(splats[0] <= 1000 && splats.contains(&2000), "{splats:?}");
    assert_eq!(inbox().part(ModelKey::from(&offer.header)), None, "nobody announced it");
}

#[test]
fn what_is_not_as_announced_is_nothing() {
    let sane = offer("drone", 1, ModelKind::Local, 1, 4000, 1024);
    let lying = Offer { header: ModelHeader { splats: 100, ..sane.header }, ..sane };
    assert_eq!(parts(inbox(), &lying), []);
}

#[test]
fn where_models_must_be_signed_it_is_nothing_before_the_whole_is_checked() {
    let key = SecretKey::new(&[1; 32]);
    let list = key.public_line(&DeviceId::new("drone").unwrap());
    let signer = Credentials { key: Some(key), ..Credentials::default() };
    let signed = offer("drone", 1, ModelKind::Local, 1, 4000, 1024)
        .with_credentials(&SiteId::new("site").unwrap(), &signer);
    let mut inbox = inbox();
    inbox.set_credentials(Credentials {
        trusted: Some(Trusted::parse(&list).unwrap()),
        ..Credentials::default()
    });
    assert_eq!(parts(inbox, &signed), []);
}
