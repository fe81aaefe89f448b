//! A receiver that is killed in the middle of a transfer goes on with what had arrived.
#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use cosurf_link::inbox::{InboxAction, InboxEvent};
use cosurf_link::{Inbox, InboxLimits, ModelKey, Offer, Role};
use cosurf_tests::offers::{identity, offer};
use cosurf_wire::{Chunk, ChunkStatus, Message, ModelHeader, ModelKind, Sealed, Topic};

const NOW: Duration = Duration::ZERO;

fn inbox(folder: &Path, total_bytes_max: u64) -> Inbox {
    let limits = InboxLimits { total_bytes_max, ..InboxLimits::default() };
    let mut inbox = Inbox::new(identity(Role::Aggregator, "ground"), limits, &[]);
    inbox.keep_arrived(folder).unwrap();
    inbox
}

fn announce(inbox: &mut Inbox, header: &ModelHeader) {
    let ModelHeader { device, model, .. } = *header;
    let event = inbox.on_header(NOW, &Topic::LocalHeader { device, model }, *header, 1);
    assert_eq!(event, Some(InboxEvent::Receiving(*header)));
}

fn send(inbox: &mut Inbox, Offer { header, body }: &Offer, index: u32) {
    let ModelHeader { device, model, .. } = *header;
    let range = header.chunk_range(index).unwrap();
    let payload = &body[range.start as usize..range.end as usize];
    let chunk = Chunk { device, model, index, payload };
    assert_eq!(inbox.on_chunk(NOW, &Topic::LocalChunk { device, model, index }, &chunk), None);
}

/// The chunks that the inbox asks for now.
fn wanted(inbox: &mut Inbox, header: &ModelHeader) -> Vec<u32> {
    let action = inbox.next(NOW);
    let Some(InboxAction::Publish(request)) = action else { panic!("nothing is asked for: {action:?}") };
    let Message::Want(want) = Sealed::decode(&request.payload).unwrap().message else { panic!("no Want") };
    let is_missing = |index: &u32| want.missing.status_of(*index) == ChunkStatus::Missing;
    (0..header.chunks()).filter(is_missing).collect()
}

/// The body that the inbox hands out for storing.
fn body(inbox: &mut Inbox) -> Vec<u8> {
    loop {
        match inbox.next(NOW).expect("the model is complete") {
            InboxAction::Store { body, .. } => return body.to_vec(),
            InboxAction::Publish(_) => {}
        }
    }
}

/// The only file in a folder.
fn file(folder: &Path) -> PathBuf {
    let mut files = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let file = files.next().expect("what has arrived is kept");
    assert_eq!(files.next(), None);
    file
}

#[test]
fn only_what_is_missing_is_asked_for_after_a_restart() {
    let folder = tempfile::tempdir().unwrap();
    let offer = offer("drone", 1, ModelKind::Local, 1, 4000, 1024);
    let header = &offer.header;
    let mut before = inbox(folder.path(), 1 << 20);
    announce(&mut before, header);
    let (odd, even): (Vec<u32>, Vec<u32>) = (0..header.chunks()).partition(|index| index % 2 == 1);
    odd.iter().for_each(|index| send(&mut before, &offer, *index));
    drop(before); // as a kill would: nothing is written at the end

    let mut after = inbox(folder.path(), 1 << 20);
    announce(&mut after, header);
    assert_eq!(wanted(&mut after, header), even);
    even.iter().for_each(|index| send(&mut after, &offer, *index));
    assert!(body(&mut after) == offer.body);
    let key = ModelKey::from(header);
    assert!(file(folder.path()).exists(), "the body is not on disk yet");
    after.stored(key);
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
}

#[test]
fn chunks_of_another_size_are_asked_for_only_where_bytes_are_missing() {
    let folder = tempfile::tempdir().unwrap();
    let offer = offer("drone", 1, ModelKind::Local, 1, 4000, 1024);
    let mut before = inbox(folder.path(), 1 << 20);
    announce(&mut before, &offer.header);
    (0..5).chain(9..11).for_each(|index| send(&mut before, &offer, index));
    drop(before);

    let header = ModelHeader { chunk_bytes: 768, ..offer.header };
    let mut after = inbox(folder.path(), 1 << 20);
    announce(&mut after, &header);
    let is_here = |index: &u32| {
        let range = header.chunk_range(*index).unwrap();
        range.end <= 5 * 1024 || (range.start >= 9 * 1024 && range.end <= 11 * 1024)
    };
    let missing: Vec<u32> = (0..header.chunks()).filter(|index| !is_here(index)).collect();
    assert!(missing.len() < header.chunks() as usize - 6);
    assert_eq!(wanted(&mut after, &header), missing);
    let offer = Offer { header, ..offer };
    missing.iter().for_each(|index| send(&mut after, &offer, *index));
    assert!(body(&mut after) == offer.body);
}

#[test]
fn damage_costs_at_most_what_arrived_after_it() {
    let offer = offer("drone", 1, ModelKind::Local, 1, 4000, 1024);
    let header = &offer.header;
    let sent = header.chunks() / 2;
    let record_bytes = 1024 + 20;
    let (name, whole) = {
        let folder = tempfile::tempdir().unwrap();
        let mut inbox = inbox(folder.path(), 1 << 20);
        announce(&mut inbox, header);
        (0..sent).for_each(|index| send(&mut inbox, &offer, index));
        let file = file(folder.path());
        (file.file_name().unwrap().to_owned(), fs::read(file).unwrap())
    };
    let head_bytes = whole.len() - sent as usize * record_bytes;
    for place in (0..whole.len()).step_by(211) {
        let folder = tempfile::tempdir().unwrap();
        let mut damaged = whole.clone();
        damaged[place] ^= 1;
        for bytes in [&damaged, &whole[..place]] {
            fs::write(folder.path().join(&name), bytes).unwrap();
            let mut inbox = inbox(folder.path(), 1 << 20);
            announce(&mut inbox, header);
            let first = wanted(&mut inbox, header)[0] as usize;
            let intact = place.checked_sub(head_bytes).map_or(0, |after| after / record_bytes);
            assert_eq!(first, intact, "byte {place}");
            (first as u32..header.chunks()).for_each(|index| send(&mut inbox, &offer, index));
            assert!(body(&mut inbox) == offer.body, "byte {place}");
        }
    }
}

#[test]
fn a_stranger_who_offers_another_model_under_the_number_spoils_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let [honest, other] = [4000, 3000].map(|splats| offer("drone", 1, ModelKind::Local, 1, splats, 1024));
    let mut before = inbox(folder.path(), 1 << 20);
    announce(&mut before, &honest.header);
    (0..5).for_each(|index| send(&mut before, &honest, index));
    drop(before);
    let mut after = inbox(folder.path(), 1 << 20);
    announce(&mut after, &other.header);
    assert_eq!(wanted(&mut after, &other.header).len(), other.header.chunks() as usize);
    drop(after);
    let mut after = inbox(folder.path(), 1 << 20);
    announce(&mut after, &honest.header);
    assert_eq!(wanted(&mut after, &honest.header)[0], 5);
}

#[test]
fn the_folder_takes_no_more_than_the_inbox() {
    let folder = tempfile::tempdir().unwrap();
    let limit = 128 << 10;
    let offers =
        ["a", "b", "c", "d", "e", "f", "g", "h"].map(|name| offer(name, 1, ModelKind::Local, 1, 1500, 1024));
    for offer in &offers {
        let mut inbox = inbox(folder.path(), limit);
        announce(&mut inbox, &offer.header);
        (0..offer.header.chunks() - 1).for_each(|index| send(&mut inbox, offer, index));
        let sizes =
            fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().metadata().unwrap().len());
        let total: u64 = sizes.sum();
        assert!(total > 0 && total <= limit, "{total} bytes");
    }
    let mut inbox = inbox(folder.path(), limit);
    announce(&mut inbox, &offers[7].header);
    assert_eq!(wanted(&mut inbox, &offers[7].header), [offers[7].header.chunks() - 1], "the newest is kept");
}

#[test]
fn what_has_arrived_from_a_sender_that_is_gone_can_be_used_once() {
    let folder = tempfile::tempdir().unwrap();
    let offer = offer("drone", 1, ModelKind::Local, 1, 4000, 1024);
    let mut before = inbox(folder.path(), 1 << 20);
    announce(&mut before, &offer.header);
    (0..offer.header.chunks() / 2).for_each(|index| send(&mut before, &offer, index));
    let key = ModelKey::from(&offer.header);
    let part = before.part(key).unwrap();
    drop(before);
    let mut after = inbox(folder.path(), 1 << 20);
    assert_eq!(after.unfinished().collect::<Vec<_>>(), [&offer.header]);
    assert_eq!(after.part(key), Some(part));
    assert_eq!(after.unfinished().count(), 0);
    assert_eq!(after.part(key), None);
}
