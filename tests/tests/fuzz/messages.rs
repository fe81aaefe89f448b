//! Fuzzes the decoders of messages, topics and frames, and an inbox that receives headers and chunks.

use std::time::Duration;

use cosurf_link::inbox::{Inbox, InboxEvent};
use cosurf_link::{Identity, InboxLimits, Offer, Role};
use cosurf_tests::keys::Signer;
use cosurf_tests::models::random_splats;
use cosurf_wire::body::CAMERA_BYTES;
use cosurf_wire::frame::{Frame, FrameReader, MAX_FRAME_BYTES, Piece, Sessions, Turn};
use cosurf_wire::{
    CONFIRMED_FLIGHT_BYTES_MAX, CameraRecord, Chunk, ConfirmedFlights, DeviceId, Done, FlightCameras,
    FlightPledge, MAX_MESSAGE_BYTES, Message, Missing, ModelId, ModelKind, Plan, RefusalReason, Refused,
    Sealed, SiteId, State, Topic, VerticalAxis, Want,
};

use crate::runner::{Target, hammer};

fn device() -> DeviceId {
    DeviceId::new("drone-7").unwrap()
}

fn offer(count: usize) -> Offer {
    let mut offer =
        Offer::new(device(), ModelId(3), ModelKind::Local, 9, &random_splats(1, count, 1), &[]).unwrap();
    offer.header.chunk_bytes = 1024;
    offer
}

fn encoded(message: &Message<'_>) -> Vec<u8> {
    message.encode(&mut [0; MAX_MESSAGE_BYTES]).unwrap().to_vec()
}

fn camera() -> [u8; CAMERA_BYTES] {
    let camera = CameraRecord {
        quat: [0.5; 4],
        translation: [1.0, 2.0, 3.0],
        focal_px: [500.0; 2],
        center_px: [320.0, 240.0],
        size_px: [640, 480],
    };
    let mut bytes = [0; CAMERA_BYTES];
    camera.encode(&mut bytes);
    bytes
}

fn messages() -> Vec<Vec<u8>> {
    let Offer { header, body } = offer(30);
    let (device, model) = (header.device, header.model);
    let chunk = Chunk { device, model, index: 1, payload: &body[200..400] };
    let missing = Missing::of(500, |i| i % 3 == 0 || i > 400);
    let cameras = camera().repeat(2);
    let out = &mut [0; CONFIRMED_FLIGHT_BYTES_MAX];
    let flights = ConfirmedFlights::encode_flight(device, header.blake3, out).repeat(3);
    let cell: Vec<u8> =
        [[0.0, 1.0], [5.0, 1.0], [2.0, 9.0]].into_iter().flat_map(Plan::encode_corner).collect();
    let plan =
        |cell| Plan { device, session: 9, frame: header.frame, vertical: VerticalAxis::Z, margin: 0.2, cell };
    [
        Message::Header(header),
        Message::Chunk(chunk),
        Message::Want(Want { device, model, session: 9, idle: true, missing }),
        Message::Done(Done { device, model, session: 9, blake3: header.blake3 }),
        Message::State(State { device, session: u64::MAX, alive: true }),
        Message::Refused(Refused { device, model, session: 9, reason: RefusalReason::Busy }),
        Message::Flight(FlightCameras { device, frame: header.frame, cameras: &cameras }),
        Message::FlightPledge(FlightPledge { device, session: 9, cameras_blake3: header.blake3 }),
        Message::ConfirmedFlights(ConfirmedFlights {
            device,
            session: 9,
            first: 1,
            total: 4,
            flights: &flights,
        }),
        Message::Plan(plan(&cell)),
        Message::Plan(plan(&[])),
    ]
    .iter()
    .flat_map(|message| {
        let sealed = match message {
            Message::Chunk(_) => None,
            message => Some(Signer::of("drone-7").seal("gs/v1/quarry/drone-7", message, 1_700_000_000, 70)),
        };
        [Some(encoded(message)), sealed]
    })
    .flatten()
    .collect()
}

fn reseal_message(bytes: &mut [u8]) {
    if let Some((content, checksum)) = bytes.split_last_chunk_mut() {
        *checksum = crc32fast::hash(content).to_le_bytes();
    }
}

/// A decoded message stays the same when it is encoded and decoded again.
#[test]
fn messages_are_read_or_refused() {
    let target = Target { name: "messages", samples: messages(), reseal: reseal_message, bytes_max: |_| 0 };
    let mut out = vec![0; MAX_MESSAGE_BYTES];
    hammer(target, move |bytes| {
        let Ok(Sealed { message, seal, signed }) = Sealed::decode(bytes) else { return false };
        assert_eq!(
            bytes.len(),
            signed.len() + 4 + seal.map_or(0, |_| 64),
            "all bytes but the signature are signed"
        );
        if let Message::Want(want) = &message {
            for i in (0..2000).chain([u32::MAX]) {
                std::hint::black_box(want.missing.status_of(i));
            }
        }
        if let Message::ConfirmedFlights(list) = &message {
            assert!(list.first as usize + list.records().count() <= list.total as usize);
        }
        if let Message::Plan(plan) = &message {
            assert!(plan.corners().len() != 1 && plan.corners().len() != 2);
            assert!(plan.corners().flatten().chain([plan.margin]).all(f64::is_finite));
        }
        let again = message.encode(&mut out).expect("what was read fits");
        // NaN is not equal to itself, so this also checks that no decoded message contains NaN.
        let is_same = Message::decode(again).expect("what was written is read") == message;
        assert!(is_same, "{message:?}");
        true
    });
}

#[test]
fn topics_are_read_or_refused() {
    let site = SiteId::new("quarry").unwrap();
    let (device, model) = (device(), ModelId(41));
    let topics = [
        Topic::State { device },
        Topic::Flight { device },
        Topic::LocalHeader { device, model },
        Topic::LocalChunk { device, model, index: 70 },
        Topic::LocalReply { device, reply: cosurf_wire::Reply::Want },
        Topic::LocalReply { device, reply: cosurf_wire::Reply::Flight },
        Topic::LocalReply { device, reply: cosurf_wire::Reply::Plan },
        Topic::GlobalHeader { tile: cosurf_wire::TileId::WHOLE },
        Topic::GlobalChunk { tile: cosurf_wire::TileId::WHOLE, model, index: 0 },
        Topic::TileHeader { device, model },
        Topic::TileChunk { device, model, index: 0 },
        Topic::GlobalReply { device, reply: cosurf_wire::Reply::Done },
    ];
    let samples = topics.iter().map(|topic| topic.to_text(&site).as_bytes().to_vec()).collect();
    let target = Target { name: "topics", samples, reseal: |_| (), bytes_max: |_| 0 };
    hammer(target, |bytes| {
        let Ok(text) = std::str::from_utf8(bytes) else { return false };
        let Ok((site, topic)) = Topic::parse(text) else { return false };
        assert_eq!(topic.to_text(&site).as_str(), text);
        true
    });
}

#[test]
fn frames_are_read_or_refused() {
    let sessions = Sessions { sender: 5, receiver: 9 };
    let turn = Turn { sessions, number: 3, copies_left: 1, has_more: true, next: 77, ..Turn::default() };
    let frames = [
        Frame::Piece(Piece { number: 70, is_last: false, payload: &[7; 200] }),
        Frame::Piece(Piece { number: 71, is_last: true, payload: b"\0end\0" }),
        Frame::Turn(turn),
    ];
    let samples =
        frames.iter().map(|frame| frame.encode(sessions, &mut [0; MAX_FRAME_BYTES]).to_vec()).collect();
    let target = Target { name: "frames", samples, reseal: |_| (), bytes_max: |_| 0 };
    let mut reader = FrameReader::default();
    hammer(target, move |bytes| {
        let mut read = false;
        // The added zero ends a frame that lost its final zero.
        for byte in bytes.iter().chain(&[0]) {
            let Some(frame) = reader.push(*byte) else { continue };
            read |= Frame::decode(frame, sessions).is_ok();
        }
        read
    });
}

/// An inbox accepts headers and chunks in any order, and stays within its limits.
#[test]
fn chunks_are_taken_or_refused() {
    let Offer { header, body } = offer(200);
    let (device, model) = (header.device, header.model);
    let chunk = |index: u32| {
        let range = header.chunk_range(index).unwrap();
        let payload = &body[range.start as usize..range.end as usize];
        encoded(&Message::Chunk(Chunk { device, model, index, payload }))
    };
    let samples = std::iter::once(encoded(&Message::Header(header))).chain((0..header.chunks()).map(chunk));
    let target = Target {
        name: "chunks",
        samples: samples.collect(),
        reseal: reseal_message,
        // 128 KiB for the bodies that the inbox may hold, and as much for its queues.
        bytes_max: |_| 1 << 18,
    };
    let limits =
        InboxLimits { body_bytes_max: 1 << 16, total_bytes_max: 1 << 17, models_max: 4, stored_max: 4 };
    let site = SiteId::new("quarry").unwrap();
    let identity =
        Identity { site, device: DeviceId::new("ground").unwrap(), session: 1, role: Role::Aggregator };
    let mut inbox = Inbox::new(identity, limits, &[]);
    let mut now = Duration::ZERO;
    hammer(target, move |bytes| {
        now += Duration::from_millis(20);
        let Ok(message) = Message::decode(bytes) else { return false };
        let refused = match &message {
            Message::Header(header) => {
                let topic = Topic::LocalHeader { device: header.device, model: header.model };
                matches!(inbox.on_header(now, &topic, *header, 1), Some(InboxEvent::Refused(..)))
            }
            Message::Chunk(chunk) => {
                let topic =
                    Topic::LocalChunk { device: chunk.device, model: chunk.model, index: chunk.index };
                matches!(inbox.on_chunk(now, &topic, chunk), Some(InboxEvent::BadChunk(..)))
            }
            _ => return false,
        };
        while inbox.next(now).is_some() {}
        assert!(inbox.unfinished_bytes() <= 1 << 17);
        !refused
    });
}
