//! Uploads over lines that break or take little: smaller chunks, what is sent again, and what goes first.
#![allow(clippy::unwrap_used)]

use std::collections::VecDeque;
use std::time::Duration;

use cosurf_link::inbox::{InboxAction, InboxEvent};
use cosurf_link::uploader::UploadEvent;
use cosurf_link::{
    Identity, Inbox, InboxLimits, Node, NodeEvent, Offer, Outgoing, PublishError, Role, Transport,
    TransportEvent, Uploader,
};
use cosurf_tests::offers::{identity, offer};
use cosurf_wire::{DeviceId, Message, ModelHeader, ModelKind, Sealed, State, TileId, Topic, Want};

const S: Duration = Duration::from_secs(1);

fn drone() -> Identity {
    identity(Role::Device, "drone")
}

/// A model of `chunks` chunks of 8 KiB, or a few more.
fn model(chunks: usize) -> Offer {
    let whole = offer("drone", 1, ModelKind::Local, 1, chunks * 640, 8192);
    assert!(whole.header.chunks() as usize >= chunks, "{} chunks", whole.header.chunks());
    whole
}

fn inbox() -> Inbox {
    Inbox::new(identity(Role::Aggregator, "ground"), InboxLimits::default(), &[])
}

/// Gives the inbox a message of the uploader.
fn deliver(inbox: &mut Inbox, now: Duration, message: &Outgoing) -> Option<InboxEvent> {
    let (_, topic) = Topic::parse(&message.topic).unwrap();
    match Message::decode(&message.payload).unwrap() {
        Message::Header(header) => inbox.on_header(now, &topic, header, 1),
        Message::Chunk(chunk) => inbox.on_chunk(now, &topic, &chunk),
        other => panic!("{other:?}"),
    }
}

/// The size of the chunks that an offer tells.
fn offered_chunk_bytes(offer: &Outgoing) -> u32 {
    match Message::decode(&offer.payload) {
        Ok(Message::Header(header)) => header.chunk_bytes,
        other => panic!("{other:?}"),
    }
}

/// Gives the uploader the requests that are due.
fn answer(inbox: &mut Inbox, uploader: &mut Uploader, now: Duration) -> Option<Want> {
    let mut last = None;
    while let Some(InboxAction::Publish(message)) = inbox.next(now) {
        let (_, topic) = Topic::parse(&message.topic).unwrap();
        let message = Message::decode(&message.payload).unwrap();
        uploader.on_reply(now, &topic, &message);
        if let Message::Want(want) = message {
            last = Some(want);
        }
    }
    last
}

/// Chunks on their way when a connection is lost are sent again at the first request after it, not only once the receiver
/// has waited in vain.
#[test]
fn what_a_broken_connection_took_along_is_sent_again_at_once() {
    let (mut uploader, mut inbox) = (Uploader::local(drone().site, model(20)), inbox());
    deliver(&mut inbox, S, &uploader.next(S).unwrap());
    answer(&mut inbox, &mut uploader, S);
    let first: Vec<Outgoing> = std::iter::from_fn(|| uploader.next(S)).collect();
    assert_eq!(first.len(), uploader.progress().chunks as usize);
    first[..10].iter().for_each(|message| assert_eq!(deliver(&mut inbox, S, message), None));
    // The rest is lost with the connection.
    uploader.on_connected(2 * S);
    deliver(&mut inbox, 2 * S, &uploader.next(2 * S).unwrap());
    assert!(!answer(&mut inbox, &mut uploader, 2 * S).unwrap().idle);
    let again: Vec<Outgoing> = std::iter::from_fn(|| uploader.next(2 * S)).collect();
    assert_eq!(again, first[10..]);
}

/// A broker repeats what the sender had not acknowledged when the connection broke, so an old request comes once more. What
/// arrived after it is not sent again. A receiver that has truly lost it says so once it is idle.
#[test]
fn an_old_request_brings_nothing_again() {
    let (mut uploader, mut inbox) = (Uploader::local(drone().site, model(20)), inbox());
    deliver(&mut inbox, S, &uploader.next(S).unwrap());
    let Some(InboxAction::Publish(old)) = inbox.next(S) else { panic!("no request") };
    let repeat = |uploader: &mut Uploader, at: Duration, idle: bool| {
        let (_, topic) = Topic::parse(&old.topic).unwrap();
        let Message::Want(want) = Message::decode(&old.payload).unwrap() else { panic!("no request") };
        uploader.on_reply(at, &topic, &Message::Want(Want { idle, ..want }));
    };
    repeat(&mut uploader, S, false);
    let first: Vec<Outgoing> = std::iter::from_fn(|| uploader.next(S)).collect();
    first[..16].iter().for_each(|message| assert_eq!(deliver(&mut inbox, S, message), None));
    answer(&mut inbox, &mut uploader, S);
    uploader.on_connected(3 * S);
    let offer = uploader.next(3 * S).unwrap();
    repeat(&mut uploader, 3 * S, false);
    assert_eq!(uploader.next(3 * S), None);
    deliver(&mut inbox, 3 * S, &offer);
    answer(&mut inbox, &mut uploader, 3 * S);
    let again: Vec<Outgoing> = std::iter::from_fn(|| uploader.next(3 * S)).collect();
    assert_eq!(again, first[16..]);
    repeat(&mut uploader, 5 * S, true);
    assert_eq!(uploader.next(5 * S).as_ref(), first.first());
}

/// The topics of messages.
fn topics(messages: &[Outgoing]) -> Vec<Topic> {
    messages.iter().map(|message| Topic::parse(&message.topic).unwrap().1).collect()
}

/// What is sent after a break, before the receiver's answer, is on its way while the answer is.
#[test]
fn the_answer_after_a_break_does_not_repeat_what_has_just_been_sent() {
    let (mut uploader, mut inbox) = (Uploader::local(drone().site, model(40)), inbox());
    deliver(&mut inbox, S, &uploader.next(S).unwrap());
    answer(&mut inbox, &mut uploader, S);
    let lost: Vec<Outgoing> = (0..10).map(|_| uploader.next(S).unwrap()).collect();
    uploader.on_resumed(2 * S, &topics(&lost));
    assert_eq!(uploader.next(2 * S).as_ref(), Some(&lost[0]));
    // The receiver asks again, as nothing has arrived.
    answer(&mut inbox, &mut uploader, 3 * S).expect("a request");
    let later: Vec<Outgoing> = std::iter::from_fn(|| uploader.next(3 * S)).collect();
    assert_eq!(later[..9], lost[1..]);
    assert!(!later.contains(&lost[0]));
}

/// A drone with a window of chunks on their way, and those chunks.
fn drone_with_a_window() -> (Uploader, Inbox, Vec<Outgoing>) {
    let model = offer("drone", 1, ModelKind::Local, 1, 120 * 640, 8192);
    let (mut uploader, mut inbox) = (Uploader::local(drone().site, model), inbox());
    deliver(&mut inbox, S, &uploader.next(S).unwrap());
    answer(&mut inbox, &mut uploader, S);
    let first: Vec<Outgoing> = std::iter::from_fn(|| uploader.next(S)).collect();
    assert_eq!(first.len(), 32, "a window");
    (uploader, inbox, first)
}

/// On a slow line that breaks each second, an offer and the wait for its answer would take the time of chunks.
#[test]
fn after_a_break_lost_chunks_are_sent_again_without_an_offer() {
    let (mut uploader, _, first) = drone_with_a_window();
    for tenth in 20..28 {
        uploader.on_resumed(tenth * S / 10, &topics(&first[2..]));
        let again: Vec<Outgoing> = std::iter::from_fn(|| uploader.next(tenth * S / 10)).collect();
        assert_eq!(again, first[2..], "however often, as the line is to blame and not the receiver");
    }
    // A receiver that has not asked for so long may not know the offer any more.
    uploader.on_resumed(6 * S, &[]);
    let offer = uploader.next(6 * S).unwrap();
    assert!(matches!(Message::decode(&offer.payload), Ok(Message::Header(_))));
}

/// A broker with a slow line to the aggregator holds chunks that a drone with a fast line has sent. A drone that was cut off
/// each second sent four times as many bytes as the model has.
#[test]
fn what_the_broker_holds_is_not_sent_again_after_a_break() {
    let (mut uploader, mut inbox, first) = drone_with_a_window();
    for (second, arrived) in [(4, 0..8), (7, 8..16)] {
        uploader.on_resumed(second * S, &[]);
        first[arrived].iter().for_each(|message| assert_eq!(deliver(&mut inbox, second * S, message), None));
        answer(&mut inbox, &mut uploader, second * S).expect("it tells what has arrived");
        let next: Vec<Outgoing> = std::iter::from_fn(|| uploader.next(second * S)).collect();
        assert!(!next.is_empty() && next.iter().all(|message| !first.contains(message)));
    }
}

/// An aggregator that was restarted with its broker drops all chunks until it has heard the offer.
#[test]
fn after_a_broker_that_has_lost_everything_chunks_wait_for_the_answer_to_the_offer() {
    let (mut uploader, mut inbox, first) = drone_with_a_window();
    uploader.on_connected(2 * S);
    let offer = uploader.next(2 * S).unwrap();
    assert_eq!(uploader.next(2 * S), None);
    deliver(&mut inbox, 2 * S, &offer);
    answer(&mut inbox, &mut uploader, 2 * S);
    let again: Vec<Outgoing> = std::iter::from_fn(|| uploader.next(2 * S)).collect();
    assert_eq!(again, first);
}

/// Sends a model in chunks of 2 KiB over a line of 30 kB/s that carries nothing for `stall`, a second after the start. Loses
/// nothing. Returns how many bytes are sent for each of the model's, and the time that it takes.
fn send_over_a_line_that_stalls(stall: Duration) -> (f64, Duration) {
    const TICK: Duration = Duration::from_millis(5);
    let offer = offer("drone", 1, ModelKind::Local, 1, 20_000, 2048);
    let body_bytes = offer.header.body_bytes as f64;
    let (mut uploader, mut inbox) = (Uploader::local(drone().site, offer), inbox());
    let (mut line, mut replies) = (VecDeque::<(Duration, Outgoing)>::new(), VecDeque::new());
    let (mut now, mut free) = (S, S);
    let mut is_finished = false;
    while !is_finished {
        now += TICK;
        assert!(now < 100 * S, "it does not arrive");
        while let Some(message) = uploader.next(now) {
            let begin = free.max(now);
            free =
                begin + Duration::from_secs_f64((message.topic.len() + message.payload.len()) as f64 / 30e3);
            if begin <= 2 * S && free > 2 * S {
                free += stall;
            }
            line.push_back((free, message));
        }
        while line.front().is_some_and(|(at, _)| *at <= now) {
            let (_, message) = line.pop_front().unwrap();
            deliver(&mut inbox, now, &message);
        }
        while let Some(action) = inbox.next(now) {
            match action {
                InboxAction::Publish(message) => replies.push_back((now + 20 * TICK, message)),
                InboxAction::Store { header, .. } => inbox.stored((&header).into()),
            }
        }
        while replies.front().is_some_and(|(at, _)| *at <= now) {
            let (_, message): (_, Outgoing) = replies.pop_front().unwrap();
            let (_, topic) = Topic::parse(&message.topic).unwrap();
            let event = uploader.on_reply(now, &topic, &Message::decode(&message.payload).unwrap());
            is_finished |= event == Some(UploadEvent::Finished);
        }
    }
    (uploader.progress().bytes_sent as f64 / body_bytes, now - S)
}

/// What is sent again in a stall arrives as duplicates. They do not make the receiver ask for what follows them: once, a stall
/// of two seconds had 2.7 times as many bytes sent.
#[test]
fn a_stall_has_little_sent_again_and_not_the_rest() {
    let (smooth, usual) = send_over_a_line_that_stalls(Duration::ZERO);
    assert!(smooth < 1.06, "{smooth}");
    for stall in [S, 2 * S, 4 * S] {
        let (sent, time) = send_over_a_line_that_stalls(stall);
        println!("{stall:?}: {sent:.2}, {time:?} instead of {usual:?}");
        assert!(sent < 1.5, "{sent} after {stall:?}");
    }
}

/// Hardly a chunk per connection: they become smaller, and what has arrived counts.
#[test]
fn chunks_become_smaller_where_few_pass_and_what_has_arrived_is_kept() {
    let (mut uploader, mut inbox) = (Uploader::local(drone().site, model(20)), inbox());
    deliver(&mut inbox, S, &uploader.next(S).unwrap());
    answer(&mut inbox, &mut uploader, S);
    let chunks: Vec<Outgoing> = std::iter::from_fn(|| uploader.next(S)).collect();
    assert_eq!(deliver(&mut inbox, S, &chunks[2]), None);
    // Twice in a row.
    for at in [2 * S, 13 * S] {
        answer(&mut inbox, &mut uploader, at);
        uploader.on_connected(at);
        if at == 2 * S {
            deliver(&mut inbox, at, &uploader.next(at).unwrap());
            answer(&mut inbox, &mut uploader, at);
            while uploader.next(at).is_some() {}
        }
    }
    let header = uploader.next(13 * S).unwrap();
    assert_eq!(offered_chunk_bytes(&header), 2048);
    deliver(&mut inbox, 13 * S, &header);
    let want = answer(&mut inbox, &mut uploader, 13 * S).unwrap();
    let has = |index| want.missing.status_of(index) == cosurf_wire::ChunkStatus::Received;
    assert_eq!((0..13).filter(|index| has(*index)).collect::<Vec<u32>>(), [8, 9, 10, 11]);
    while let Some(chunk) = uploader.next(13 * S) {
        deliver(&mut inbox, 13 * S, &chunk);
        while let Some(action) = inbox.next(13 * S) {
            match action {
                InboxAction::Store { body, .. } => {
                    assert_eq!(*body, model(20).body);
                    return;
                }
                InboxAction::Publish(reply) => {
                    let (_, topic) = Topic::parse(&reply.topic).unwrap();
                    uploader.on_reply(13 * S, &topic, &Message::decode(&reply.payload).unwrap());
                }
            }
        }
    }
    panic!("the model is not complete");
}

/// Unsigned, and no chunk has ever arrived: the smaller ones are taken at once, though the receiver has just been told of the
/// model.
#[test]
fn smaller_chunks_are_taken_at_once_while_none_has_arrived() {
    let (mut uploader, mut inbox) = (Uploader::local(drone().site, model(20)), inbox());
    for at in [S, 4 * S] {
        deliver(&mut inbox, at, &uploader.next(at).unwrap());
        answer(&mut inbox, &mut uploader, at);
        // All chunks are lost with the connection.
        while uploader.next(at).is_some() {}
        uploader.on_connected(at + 3 * S);
    }
    let header = uploader.next(7 * S).unwrap();
    deliver(&mut inbox, 7 * S, &header);
    let chunk_bytes = offered_chunk_bytes(&header);
    assert!(chunk_bytes < 8192, "{chunk_bytes}");
    answer(&mut inbox, &mut uploader, 7 * S);
    let chunk = uploader.next(7 * S).unwrap();
    deliver(&mut inbox, 7 * S, &chunk);
    let want = answer(&mut inbox, &mut uploader, 60 * S).unwrap();
    assert_eq!(want.missing.status_of(0), cosurf_wire::ChunkStatus::Received, "the small chunk has arrived");
}

/// If the sender does not sign, a receiver that has a chunk refuses smaller ones until no chunk has arrived for ten seconds. Before,
/// smaller ones would be sent in vain.
#[test]
fn chunks_of_a_sender_that_does_not_sign_keep_their_size_once_one_has_arrived() {
    let (mut uploader, mut inbox) = (Uploader::local(drone().site, model(20)).unsigned(), inbox());
    deliver(&mut inbox, S, &uploader.next(S).unwrap());
    answer(&mut inbox, &mut uploader, S);
    let chunks: Vec<Outgoing> = std::iter::from_fn(|| uploader.next(S)).collect();
    assert_eq!(deliver(&mut inbox, S, &chunks[2]), None);
    for at in [4 * S, 7 * S, 10 * S, 13 * S] {
        answer(&mut inbox, &mut uploader, at);
        uploader.on_connected(at);
        let offered = uploader.next(at).unwrap();
        assert_eq!(offered_chunk_bytes(&offered), 8192);
        deliver(&mut inbox, at, &offered);
        answer(&mut inbox, &mut uploader, at);
        while uploader.next(at).is_some() {}
    }
    // Ten seconds after the only chunk was told, they are taken.
    let at = 16 * S;
    uploader.on_connected(at);
    let offered = uploader.next(at).unwrap();
    assert_eq!(offered_chunk_bytes(&offered), 2048);
    deliver(&mut inbox, at, &offered);
    answer(&mut inbox, &mut uploader, at);
    let chunk = uploader.next(at).unwrap();
    deliver(&mut inbox, at, &chunk);
    let want = answer(&mut inbox, &mut uploader, 60 * S).unwrap();
    let count = (0..80).filter(|i| want.missing.status_of(*i) == cosurf_wire::ChunkStatus::Received).count();
    assert_eq!(count, 5, "the large one, and a small one");
}

/// On a slow line that breaks each second, an offer at each connection would take the time of chunks.
#[test]
fn a_drone_that_has_just_asked_for_chunks_is_not_told_of_the_global_model_again() {
    let (site, device) = (drone().site, drone().device);
    let model = offer("ground", 1, ModelKind::Global, 1, 20 * 640, 8192);
    let mut uploader = Uploader::global(site, TileId::WHOLE, model, &[device]);
    let mut inbox = Inbox::new(Identity { role: Role::Device, ..drone() }, InboxLimits::default(), &[]);
    deliver(&mut inbox, S, &uploader.next(S).unwrap());
    answer(&mut inbox, &mut uploader, S);
    while uploader.next(S).is_some() {}
    uploader.on_birth(2 * S, DeviceId::new("other").unwrap());
    let offered = uploader.next(2 * S).expect("another drone may not know it");
    assert!(matches!(Message::decode(&offered.payload), Ok(Message::Header(_))));
    answer(&mut inbox, &mut uploader, 2 * S);
    uploader.on_birth(3 * S, device);
    assert_eq!(uploader.next(3 * S), None);
}

#[test]
fn a_good_connection_keeps_its_chunks() {
    let (mut uploader, mut inbox) = (Uploader::local(drone().site, model(20)), inbox());
    deliver(&mut inbox, S, &uploader.next(S).unwrap());
    answer(&mut inbox, &mut uploader, S);
    let chunks: Vec<Outgoing> = std::iter::from_fn(|| uploader.next(S)).collect();
    chunks[..5].iter().for_each(|chunk| assert_eq!(deliver(&mut inbox, S, chunk), None));
    answer(&mut inbox, &mut uploader, 4 * S);
    uploader.on_connected(12 * S);
    let header = uploader.next(12 * S).unwrap();
    assert_eq!(offered_chunk_bytes(&header), 8192);
}

/// A link that takes no chunks.
struct Congested {
    events: Vec<TransportEvent>,
    sent: Vec<Outgoing>,
}

impl Transport for Congested {
    fn publish(&mut self, message: &Outgoing) -> Result<(), PublishError> {
        if message.is_chunk() {
            return Err(PublishError::Busy);
        }
        self.sent.push(message.clone());
        Ok(())
    }

    fn poll(&mut self, _: Duration) -> Option<TransportEvent> {
        self.events.pop()
    }
}

/// While the line is full of chunks, a device still answers and announces.
#[test]
fn control_messages_do_not_wait_behind_chunks() {
    let mut node = Node::new(drone(), InboxLimits::default(), &[]);
    let mut link = Congested { events: vec![TransportEvent::Connected], sent: Vec::new() };
    assert!(matches!(node.step(&mut link, || S, Duration::ZERO), Some(NodeEvent::Connected)));
    let whole = model(20);
    node.upload(whole.clone());
    while node.step(&mut link, || S, Duration::ZERO).is_some() {}
    let ModelHeader { device, model, .. } = whole.header;
    let want =
        Want { device, model, session: drone().session, idle: false, missing: cosurf_wire::Missing::all() };
    let (reply, mut payload) = (cosurf_wire::Reply::Want, vec![0; 1024]);
    let sealed = Message::Want(want).encode(&mut payload).unwrap().to_vec();
    let topic = Topic::LocalReply { device, reply }.to_text(&drone().site).as_str().to_owned();
    link.events.push(TransportEvent::Incoming { topic, payload: sealed });
    node.step(&mut link, || 2 * S, Duration::ZERO);
    node.step(&mut link, || 2 * S, Duration::ZERO);
    // A chunk waits now. The cameras of the flight go all the same.
    link.sent.clear();
    node.announce_flight(&[]);
    node.step(&mut link, || 3 * S, Duration::ZERO);
    let is_flight =
        |message: &Outgoing| matches!(Topic::parse(&message.topic), Ok((_, Topic::Flight { .. })));
    assert!(link.sent.iter().any(is_flight), "{:?}", link.sent);
    assert!(Sealed::decode(&link.sent[0].payload).is_ok());
}

/// A receiver of a global model that has its header, at time 1 s, and a chunk of it.
struct Fetching {
    node: Node,
    link: Congested,
    chunk: Outgoing,
}

impl Fetching {
    fn start() -> Self {
        let mut fetching = Self {
            node: Node::new(drone(), InboxLimits::default(), &[]),
            link: Congested { events: Vec::new(), sent: Vec::new() },
            chunk: Outgoing { topic: cosurf_wire::TopicString::new(), payload: Vec::new(), retain: false },
        };
        let model = offer("ground", 1, ModelKind::Global, 1, 20 * 640, 8192);
        let mut uploader = Uploader::global(drone().site, TileId::WHOLE, model.clone(), &[drone().device]);
        let header = uploader.next(S).unwrap();
        let ModelHeader { device, model, .. } = model.header;
        let want = Want { device, model, session: 1, idle: false, missing: cosurf_wire::Missing::all() };
        let topic = Topic::GlobalReply { device: drone().device, reply: cosurf_wire::Reply::Want };
        uploader.on_reply(S, &topic, &Message::Want(want));
        fetching.chunk = uploader.next(S).unwrap();
        assert_eq!(fetching.wants_after(TransportEvent::Connected, S), 0);
        assert_eq!(fetching.wants_after(incoming(&header), S), 1);
        fetching
    }

    /// Number of requests that follow an event.
    fn wants_after(&mut self, event: TransportEvent, at: Duration) -> usize {
        self.link.events.push(event);
        (0..4).for_each(|_| drop(self.node.step(&mut self.link, || at, Duration::ZERO)));
        let sent = std::mem::take(&mut self.link.sent);
        sent.iter().filter(|message| message.topic.as_str().ends_with("/want")).count()
    }

    fn wants_after_chunk(&mut self, at: Duration) -> usize {
        let chunk = incoming(&self.chunk);
        self.wants_after(chunk, at)
    }
}

fn incoming(message: &Outgoing) -> TransportEvent {
    TransportEvent::Incoming { topic: message.topic.as_str().to_owned(), payload: message.payload.clone() }
}

/// At its next connection, the sender judges by this whether its chunks get through.
#[test]
fn a_receiver_that_is_connected_again_tells_at_once_what_has_arrived() {
    let mut receiver = Fetching::start();
    assert_eq!(receiver.wants_after(TransportEvent::Connected, S + S / 10), 0, "nothing is new");
    assert_eq!(receiver.wants_after_chunk(S + S / 5), 0, "more chunks may follow");
    assert_eq!(receiver.wants_after(TransportEvent::Connected, S + S / 2), 1);
}

/// After a break, this takes the place of an offer and its answer.
#[test]
fn a_sender_that_is_connected_again_is_told_at_once_what_has_arrived() {
    let mut receiver = Fetching::start();
    let birth = |device: &str| {
        let state = State { device: DeviceId::new(device).unwrap(), session: 1, alive: true };
        let mut buffer = [0; cosurf_wire::MAX_CONTROL_BYTES];
        let payload = Message::State(state).encode(&mut buffer).unwrap().to_vec();
        let topic = Topic::State { device: state.device }.to_text(&drone().site);
        incoming(&Outgoing { topic, payload, retain: false })
    };
    assert_eq!(receiver.wants_after(birth("ground"), S + S / 10), 0, "nothing is new");
    assert_eq!(receiver.wants_after_chunk(S + S / 5), 0, "more chunks may follow");
    assert_eq!(receiver.wants_after(birth("other"), S + S / 2), 0, "it sends something else");
    assert_eq!(receiver.wants_after(birth("ground"), S + S / 2), 1);
}

/// The same for a global model: each connection of the drone begins with its birth.
#[test]
fn chunks_of_a_global_model_become_smaller_for_a_drone_that_few_reach() {
    let (site, device) = (drone().site, drone().device);
    let model = offer("ground", 1, ModelKind::Global, 1, 20 * 640, 8192);
    let mut uploader = Uploader::global(site, TileId::WHOLE, model, &[device]);
    let drone = Identity { role: Role::Device, ..drone() };
    let mut inbox = Inbox::new(drone, InboxLimits::default(), &[]);
    deliver(&mut inbox, S, &uploader.next(S).unwrap());
    answer(&mut inbox, &mut uploader, S);
    let chunks: Vec<Outgoing> = std::iter::from_fn(|| uploader.next(S)).collect();
    for (at, index) in [(10 * S, 0), (20 * S, 1)] {
        deliver(&mut inbox, at, &chunks[index]);
        uploader.on_birth(at, device);
        let offered = uploader.next(at).unwrap();
        deliver(&mut inbox, at, &offered);
        assert_eq!(offered_chunk_bytes(&offered), if index == 0 { 8192 } else { 2048 });
        answer(&mut inbox, &mut uploader, at);
    }
    // Births of others change nothing.
    let other = DeviceId::new("other").unwrap();
    for at in [30 * S, 40 * S] {
        uploader.on_birth(at, other);
    }
    assert_eq!(
        std::iter::from_fn(|| uploader.next(41 * S)).find_map(|message| {
            match Message::decode(&message.payload) {
                Ok(Message::Header(header)) => Some(header.chunk_bytes),
                _ => None,
            }
        }),
        Some(2048)
    );
}

/// All chunks are lost, and every connection is shorter than the receiver's wait before it asks again. It must still ask. In an
/// earlier version, a download over a line that broke each second never ended.
#[test]
fn what_is_lost_is_asked_for_although_connections_are_short() {
    let mut node = Node::new(drone(), InboxLimits::default(), &[]);
    let mut link = Congested { events: vec![TransportEvent::Connected], sent: Vec::new() };
    let model = offer("ground", 1, ModelKind::Global, 1, 20 * 640, 8192);
    let header = Uploader::global(drone().site, TileId::WHOLE, model, &[drone().device]).next(S).unwrap();
    let mut take = |link: &mut Congested, now: Duration, event: TransportEvent| {
        link.events.push(event);
        while node.step(link, || now, Duration::ZERO).is_some() {}
        node.step(link, || now, Duration::ZERO);
    };
    take(&mut link, S, incoming(&header));
    let is_idle = |message: &Outgoing| match Sealed::decode(&message.payload) {
        Ok(Sealed { message: Message::Want(want), .. }) => want.idle,
        _ => false,
    };
    let asked = (2..30).find(|second| {
        let reason = "cut".to_owned();
        take(&mut link, *second * S, TransportEvent::Disconnected { attempt: 1, reason });
        take(&mut link, *second * S, TransportEvent::Connected);
        link.sent.iter().any(is_idle)
    });
    // Not at once: what the broker has kept may still come.
    assert!(asked.is_some_and(|second| (4..15).contains(&second)), "{asked:?}");
}
