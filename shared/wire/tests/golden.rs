//! The exact bytes of every message, and of the parts of a body: head, table, shapes, changes and spherical
//! harmonics. If any of these bytes change, the version must change too.
#![allow(clippy::unwrap_used)]

use cosurf_wire::body::{
    BodyError, BodyHead, BodyPlan, CAMERA_BYTES, HEAD_BYTES, PACK_ENTRY_BYTES, Pack, PackEntry, PackForm,
    PackKind, SHAPE_BYTES, ShLayout, Shape, SplatPacks, read_changes, read_shapes, write_changes,
    write_shapes,
};
use cosurf_wire::message::{REFUSAL_BEFORE_BYTES, refusal_for_version_before};
use cosurf_wire::missing::MISSING_BITMAP_BYTES;
use cosurf_wire::seal::{MAX_SEAL_BYTES, seal, statement};
use cosurf_wire::{
    BodyCodec, BodyHash, Bounds, CAMERAS_MAX, CONFIRMED_FLIGHT_BYTES_MAX, CONFIRMED_FLIGHTS_MAX,
    CameraRecord, Chunk, ConfirmedFlights, DeviceId, Done, FLIGHT_CAMERAS_MAX, FlightCameras, FlightPledge,
    FrameId, HeaderError, MAX_CHUNK_BYTES, MAX_CONTROL_BYTES, MAX_MESSAGE_BYTES, Message, Missing,
    ModelHeader, ModelId, ModelKind, PLAN_COORDINATE_MAX, PLAN_CORNERS_MAX, Plan, RefusalReason, Refused,
    Seal, Sealed, Signature, SiteId, State, Topic, VERSION, VerticalAxis, Want, WireError,
};

fn header() -> ModelHeader {
    ModelHeader {
        device: DeviceId::new("d-1").unwrap(),
        model: ModelId(300),
        kind: ModelKind::Local,
        frame: FrameId::new("enu").unwrap(),
        codec: BodyCodec::Packed,
        sh_degree: 2,
        splats: 1000,
        cameras: 7,
        views: 8,
        bounds: Bounds { min: [-1.0, 0.0, 0.5], max: [1.0, 2.0, 4.0] },
        body_bytes: 16_000,
        chunk_bytes: 4096,
        blake3: BodyHash([0xab; 32]),
    }
}

fn camera_bytes(count: usize) -> Vec<u8> {
    let camera = CameraRecord {
        quat: [1.0, 0.0, 0.0, 0.0],
        translation: [1.0, 2.0, 3.0],
        focal_px: [500.0; 2],
        center_px: [320.0, 240.0],
        size_px: [640, 480],
    };
    let mut bytes = [0; CAMERA_BYTES];
    camera.encode(&mut bytes);
    bytes.repeat(count)
}

#[test]
fn headers_tell_models_without_a_place_and_those_of_0_1_have_one() {
    let encoded = |codec| {
        let mut buffer = [0; MAX_CONTROL_BYTES];
        let message = Message::Header(ModelHeader { codec, ..header() });
        message.encode(&mut buffer).unwrap().to_vec()
    };
    // `messages_have_these_bytes` has the bytes of 0.1.
    let [before, now] = [BodyCodec::Packed, BodyCodec::PackedUnplaced].map(encoded);
    let differs: Vec<usize> = (0..before.len() - 4).filter(|&i| before[i] != now[i]).collect();
    assert!(before.len() == now.len() && differs.len() == 1, "one byte tells it: {differs:?}");
    let placed = |bytes: &[u8]| match Message::decode_stored(bytes).unwrap() {
        Message::Header(header) => header.is_placed(),
        other => panic!("{other:?}"),
    };
    assert!(placed(&before) && !placed(&now));
}

#[test]
fn flights_with_invalid_cameras_are_refused() {
    let (device, frame) = (DeviceId::new("d").unwrap(), FrameId::default());
    let decoded = |cameras: &[u8]| {
        let mut buffer = vec![0; MAX_MESSAGE_BYTES];
        let message = Message::Flight(FlightCameras { device, frame, cameras });
        Message::decode(message.encode(&mut buffer).unwrap()).map(|_| ())
    };
    assert_eq!(decoded(&camera_bytes(FLIGHT_CAMERAS_MAX)), Ok(()));
    assert_eq!(decoded(&[]), Ok(()), "a flight without cameras is valid");
    assert_eq!(decoded(&camera_bytes(FLIGHT_CAMERAS_MAX + 1)), Err(WireError::BadFlight));
    assert_eq!(decoded(&camera_bytes(2)[1..]), Err(WireError::BadFlight));
    let mut invalid = camera_bytes(1);
    invalid[7] = 0xff;
    assert_eq!(decoded(&invalid), Err(WireError::BadFlight), "a rotation of NaN");
}

/// The encoded list of the flights of these devices.
fn confirmed(names: &[&str]) -> Vec<u8> {
    let encode = |name: &&str| {
        let device = DeviceId::new(name).unwrap();
        ConfirmedFlights::encode_flight(device, BodyHash([0xef; 32]), &mut [0; CONFIRMED_FLIGHT_BYTES_MAX])
            .to_vec()
    };
    names.iter().flat_map(encode).collect()
}

#[test]
fn lists_of_flights_that_contradict_themselves_are_refused() {
    let device = DeviceId::new("d").unwrap();
    let decoded = |first, total, flights: &[u8]| {
        let mut buffer = vec![0; MAX_MESSAGE_BYTES];
        let list = ConfirmedFlights { device, session: 1, first, total, flights };
        let decoded =
            Message::decode(Message::ConfirmedFlights(list).encode(&mut buffer).unwrap()).map(|_| ());
        (decoded, list.records().count())
    };
    let many = confirmed(&vec!["d"; CONFIRMED_FLIGHTS_MAX + 1]);
    let most = &many[..many.len() / (CONFIRMED_FLIGHTS_MAX + 1) * CONFIRMED_FLIGHTS_MAX];
    assert_eq!(decoded(0, 0, &[]), (Ok(()), 0), "an empty list is valid");
    assert_eq!(decoded(7, 7 + CONFIRMED_FLIGHTS_MAX as u32, most), (Ok(()), CONFIRMED_FLIGHTS_MAX));
    assert_eq!(decoded(8, 7 + CONFIRMED_FLIGHTS_MAX as u32, most).0, Err(WireError::BadFlight));
    assert_eq!(decoded(u32::MAX, u32::MAX, most).0, Err(WireError::BadFlight));
    assert_eq!(decoded(0, 1000, &many).0, Err(WireError::BadFlight), "too many");
    assert_eq!(decoded(0, 1000, &most[..most.len() - 1]).0, Err(WireError::BadFlight), "torn");
}

/// The encoded corners of a cell.
fn encoded_corners(corners: &[[f64; 2]]) -> Vec<u8> {
    corners.iter().copied().flat_map(Plan::encode_corner).collect()
}

#[test]
fn plans_with_invalid_cells_or_margins_are_refused() {
    let (device, frame, vertical) = (DeviceId::new("d").unwrap(), FrameId::default(), VerticalAxis::Z);
    let decoded = |margin, cell: &[u8]| {
        let mut buffer = vec![0; MAX_MESSAGE_BYTES];
        let plan = Plan { device, session: 1, frame, vertical, margin, cell };
        Message::decode(Message::Plan(plan).encode(&mut buffer).unwrap()).map(|_| ())
    };
    let refused = Err(WireError::BadPlan);
    let most = encoded_corners(&[[-PLAN_COORDINATE_MAX, 2.5]; PLAN_CORNERS_MAX]);
    assert_eq!(decoded(0.0, &[]), Ok(()), "no cell for the device");
    assert_eq!([decoded(0.0, &most), decoded(1.0, &most[..48])], [Ok(()); 2]);
    assert_eq!(decoded(0.2, &[&most[..], &most[..16]].concat()), refused, "too many corners");
    assert_eq!(decoded(0.2, &most[..32]), refused, "too few");
    assert_eq!([decoded(0.2, &most[..47]), decoded(0.2, &most[..7])], [refused; 2], "torn");
    for wrong in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1.001 * PLAN_COORDINATE_MAX] {
        let cell = encoded_corners(&[[0.0, 0.0], [1.0, 0.0], [0.0, wrong]]);
        assert_eq!(decoded(0.2, &cell), refused, "{wrong}");
    }
    for margin in [-0.001, 1.001, f64::NAN, f64::INFINITY] {
        assert_eq!([decoded(margin, &most), decoded(margin, &[])], [refused; 2], "{margin}");
    }
}

#[test]
fn corners_are_read_as_they_were_written() {
    let corners = [[-1.5, 2.0], [1e8, -0.0], [0.1, 3.25]];
    let cell = encoded_corners(&corners);
    let (device, frame) = (DeviceId::new("d").unwrap(), FrameId::default());
    let plan = Plan { device, session: 1, frame, vertical: VerticalAxis::Y, margin: 0.2, cell: &cell };
    assert_eq!(plan.corners().collect::<Vec<_>>(), corners);
    assert_eq!([VerticalAxis::X, VerticalAxis::Y, VerticalAxis::Z].map(VerticalAxis::index), [0, 1, 2]);
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// A message is encoded as version, index of the variant, fields in declaration order, CRC-32.
#[test]
fn messages_have_these_bytes() {
    let (device, model) = (DeviceId::new("d-1").unwrap(), ModelId(300));
    let header_bytes = "0300".to_owned()
        + "03642d31" // device
        + "ac02" // model
        + "00" // kind
        + "03656e75" // frame
        + "00" // codec
        + "02" // degree
        + "e807" // splats
        + "07" // cameras
        + "08" // views
        + "000080bf000000000000003f0000803f0000004000008040" // bounds
        + "807d" // body bytes
        + "8020" // chunk bytes
        + &"ab".repeat(32); // hash
    let missing = Missing::of(20, |i| i < 3 || i == 5);
    let cameras = camera_bytes(1);
    let flights = confirmed(&["d-1", "e"]);
    let frame = FrameId::new("enu").unwrap();
    let cell = encoded_corners(&[[0.0, 1.0], [2.0, -1.0], [0.5, 1.5]]);
    let table = [
        (Message::Header(header()), header_bytes),
        (
            Message::Chunk(Chunk { device, model, index: 200, payload: &[1, 2, 3] }),
            "0301 03642d31 ac02 c801 03 010203".to_owned(),
        ),
        (
            Message::Want(Want { device, model, session: 77, idle: true, missing }),
            "0302 03642d31 ac02 4d 01 03 01 03 06".into(),
        ),
        (
            Message::Done(Done { device, model, session: 77, blake3: BodyHash([0xcd; 32]) }),
            "0303 03642d31 ac02 4d".to_owned() + &"cd".repeat(32),
        ),
        (Message::State(State { device, session: 77, alive: true }), "0304 03642d31 4d 01".into()),
        (
            Message::Refused(Refused { device, model, session: 77, reason: RefusalReason::Replayed }),
            "0305 03642d31 ac02 4d 07".into(),
        ),
        (
            Message::Flight(FlightCameras { device, frame: FrameId::new("enu").unwrap(), cameras: &cameras }),
            "0306 03642d31 03656e75 60".to_owned() + &hex(&cameras),
        ),
        (
            Message::FlightPledge(FlightPledge { device, session: 77, cameras_blake3: BodyHash([0xcd; 32]) }),
            "0307 03642d31 4d".to_owned() + &"cd".repeat(32),
        ),
        (
            Message::ConfirmedFlights(ConfirmedFlights {
                device,
                session: 77,
                first: 3,
                total: 300,
                flights: &flights,
            }),
            "0308 03642d31 4d 03 ac02 46 03642d31".to_owned() + &"ef".repeat(32) + "0165" + &"ef".repeat(32),
        ),
        (
            Message::Plan(Plan {
                device,
                session: 77,
                frame,
                vertical: VerticalAxis::Z,
                margin: 0.5,
                cell: &cell,
            }),
            "0309 03642d31 4d 03656e75 02 000000000000e03f 30".to_owned()
                + "0000000000000000 000000000000f03f 0000000000000040"
                + "000000000000f0bf 000000000000e03f 000000000000f83f",
        ),
    ];
    for (message, expected) in table {
        let mut buffer = [0; 1024];
        let bytes = message.encode(&mut buffer).unwrap();
        let (content, checksum) = bytes.split_last_chunk::<4>().unwrap();
        assert_eq!(hex(content), expected.replace(' ', ""), "{message:?}");
        assert_eq!(crc32fast::hash(content), u32::from_le_bytes(*checksum));
        assert_eq!(Message::decode(bytes).unwrap(), message);
    }
}

/// A reason is encoded as the index of its variant, so the order of the variants is part of the wire
/// format.
#[test]
fn reasons_have_these_numbers() {
    use RefusalReason::*;
    let reasons = [
        TooLarge,
        Busy,
        BadBody,
        NumberTaken,
        StoreFailed,
        Withdrawn,
        WrongFrame,
        Replayed,
        Garbled,
        TooManyDevices,
    ];
    for (number, reason) in reasons.into_iter().enumerate() {
        let (device, model) = (DeviceId::new("d").unwrap(), ModelId(0));
        let mut buffer = [0; 64];
        let bytes =
            Message::Refused(Refused { device, model, session: 0, reason }).encode(&mut buffer).unwrap();
        assert_eq!(usize::from(bytes[bytes.len() - 5]), number, "{reason:?}");
    }
}

#[test]
fn the_largest_messages_have_the_documented_sizes() {
    let name = "x".repeat(cosurf_wire::id::MAX_ID_BYTES);
    let (device, model) = (DeviceId::new(&name).unwrap(), ModelId(u64::MAX));
    let frame = FrameId::new(&name).unwrap();
    let largest = ModelHeader {
        device,
        model,
        frame,
        splats: u32::MAX,
        cameras: u32::MAX,
        views: u32::MAX,
        body_bytes: u64::MAX,
        chunk_bytes: u32::MAX,
        ..header()
    };
    let mut buffer = vec![0; MAX_MESSAGE_BYTES];
    let mut bytes_of = |message: Message<'_>| message.encode(&mut buffer).unwrap().len();
    let missing =
        Missing::of(u32::MAX, |i| i % 2 == 1 && i < 16 * MISSING_BITMAP_BYTES as u32 || i == u32::MAX - 2);
    let session = u64::MAX;
    let controls = [
        bytes_of(Message::Header(largest)),
        bytes_of(Message::Want(Want { device, model, session, idle: true, missing })),
        bytes_of(Message::Done(Done { device, model, session, blake3: BodyHash([0; 32]) })),
        bytes_of(Message::State(State { device, session, alive: true })),
        bytes_of(Message::Refused(Refused { device, model, session, reason: RefusalReason::Busy })),
        bytes_of(Message::FlightPledge(FlightPledge { device, session, cameras_blake3: BodyHash([0; 32]) })),
    ];
    let small = Message::State(State { device, session, alive: true });
    let unsealed = small.encode(&mut [0; MAX_CONTROL_BYTES]).unwrap().to_vec();
    let sign = |_: &[u8]| Signature { r: [1; 32], s: [2; 32] };
    let sealed = seal(&unsealed, (device, u64::MAX, u64::MAX), sign, &mut [0; 512]).unwrap().len();
    assert_eq!(sealed - unsealed.len(), MAX_SEAL_BYTES);
    assert_eq!(
        controls.iter().max().map(|bytes| bytes + MAX_SEAL_BYTES),
        Some(MAX_CONTROL_BYTES),
        "{controls:?}"
    );
    let refusal = refusal_for_version_before(device, model, &mut [0; REFUSAL_BEFORE_BYTES]).len();
    assert_eq!(refusal, REFUSAL_BEFORE_BYTES);
    let payload = vec![0; MAX_CHUNK_BYTES];
    let chunk = bytes_of(Message::Chunk(Chunk { device, model, index: u32::MAX, payload: &payload }));
    assert_eq!(chunk, MAX_MESSAGE_BYTES);
    let cameras = camera_bytes(FLIGHT_CAMERAS_MAX);
    let flight = Message::Flight(FlightCameras { device, frame, cameras: &cameras });
    let most = flight.bytes_max();
    assert!(bytes_of(flight) <= most && most <= 16 * 1024, "a flight fits a serial line");
    let flights = confirmed(&vec![&*name; CONFIRMED_FLIGHTS_MAX]);
    assert_eq!(flights.len(), CONFIRMED_FLIGHTS_MAX * CONFIRMED_FLIGHT_BYTES_MAX);
    let list = ConfirmedFlights { device, session, first: u32::MAX, total: u32::MAX, flights: &flights };
    let list = Message::ConfirmedFlights(list);
    let most = list.bytes_max();
    assert!(bytes_of(list) <= most && most <= 16 * 1024, "a list of flights fits a serial line");
    let cell = encoded_corners(&[[1.0; 2]; PLAN_CORNERS_MAX]);
    let vertical = VerticalAxis::Z;
    let plan = Message::Plan(Plan { device, session, frame, vertical, margin: 1.0, cell: &cell });
    let most = plan.bytes_max();
    assert!(bytes_of(plan) + MAX_SEAL_BYTES <= most && most == MAX_CONTROL_BYTES + 1024, "{most} bytes");
}

/// A seal is encoded behind the message: sender, session, count, signature. The signature covers a prefix, the topic with
/// the site, and all bytes before it.
#[test]
fn seals_have_these_bytes_and_cover_these() {
    let device = DeviceId::new("d-1").unwrap();
    let topic = Topic::State { device }.to_text(&SiteId::new("s").unwrap());
    let mut buffer = [0; MAX_CONTROL_BYTES];
    let state = Message::State(State { device, session: 77, alive: true });
    let encoded = state.encode(&mut buffer).unwrap().to_vec();
    let mut covered = Vec::new();
    let sign = |signed: &[u8]| {
        covered = statement(&topic, signed).concat();
        Signature { r: [0x11; 32], s: [0x22; 32] }
    };
    let bytes = seal(&encoded, (device, 77, 300), sign, &mut buffer).unwrap();
    let signed = "0304 03642d31 4d 01 03642d31 4d ac02".replace(' ', "");
    assert_eq!(hex(&covered), hex(b"cosurf message\0gs/v1/s/d-1/state\0") + &signed);
    let (content, checksum) = bytes.split_last_chunk::<4>().unwrap();
    assert_eq!(hex(content), signed + &"11".repeat(32) + &"22".repeat(32));
    assert_eq!(crc32fast::hash(content), u32::from_le_bytes(*checksum));
    let sealed = Sealed::decode(bytes).unwrap();
    let signature = Signature { r: [0x11; 32], s: [0x22; 32] };
    assert_eq!(sealed.message, state);
    assert_eq!(sealed.seal, Some(Seal { sender: device, session: 77, count: 300, signature }));
    assert_eq!(statement(&topic, sealed.signed).concat(), covered);
    assert_eq!(Message::decode(bytes), Ok(state));
    assert_eq!(Sealed::decode(&encoded).unwrap().seal, None);
}

#[test]
fn a_chunk_has_no_seal() {
    let (device, model) = (DeviceId::new("d-1").unwrap(), ModelId(300));
    let mut buffer = [0; 512];
    let chunk = Message::Chunk(Chunk { device, model, index: 0, payload: &[1] });
    let encoded = chunk.encode(&mut buffer).unwrap().to_vec();
    let sign = |_: &[u8]| Signature { r: [0x11; 32], s: [0x22; 32] };
    let bytes = seal(&encoded, (device, 1, 1), sign, &mut buffer).unwrap();
    assert_eq!(Sealed::decode(bytes), Err(WireError::TrailingBytes));
}

/// A folder of version 0.1 holds headers of version 2, with and without a signature.
#[test]
fn a_stored_header_of_the_version_before_is_read() {
    let mut buffer = [0; MAX_CONTROL_BYTES];
    let encoded = Message::Header(header()).encode(&mut buffer).unwrap().to_vec();
    let before = |variant: u8, signature: &[u8]| {
        let content = [&[2, variant], &encoded[2..encoded.len() - 4], signature].concat();
        let checksum = crc32fast::hash(&content).to_le_bytes();
        [content, checksum.to_vec()].concat()
    };
    let signed = [&[1][..], &[7; 64]].concat();
    for signature in [&[0][..], &signed] {
        let bytes = before(0, signature);
        assert_eq!(Message::decode_stored(&bytes), Ok(Message::Header(header())));
        assert_eq!(Message::decode(&bytes), Err(WireError::UnknownVersion(2)));
    }
    assert_eq!(Message::decode_stored(&encoded), Ok(Message::Header(header())));
    let device = DeviceId::new("d-1").unwrap();
    let mut out = [0; REFUSAL_BEFORE_BYTES];
    let refusal = refusal_for_version_before(device, ModelId(300), &mut out);
    let (content, checksum) = refusal.split_last_chunk::<4>().unwrap();
    assert_eq!(hex(content), "020503642d31ac0200", "as version 2 has written it");
    assert_eq!(crc32fast::hash(content), u32::from_le_bytes(*checksum));
    assert!(Message::decode_stored(refusal).is_err(), "only headers are read");
}

#[test]
fn each_invalid_message_has_its_own_error() {
    let mut buffer = [0; MAX_CONTROL_BYTES];
    let valid = Message::Header(header()).encode(&mut buffer).unwrap().to_vec();
    let with_new_checksum = |change: &dyn Fn(&mut Vec<u8>)| {
        let mut bytes = valid[..valid.len() - 4].to_vec();
        change(&mut bytes);
        let checksum = crc32fast::hash(&bytes).to_le_bytes();
        [bytes, checksum.to_vec()].concat()
    };
    let decoded = |bytes: &[u8]| Message::decode(bytes).map(|_| ()).unwrap_err();
    assert_eq!(decoded(&[]), WireError::Empty);
    assert_eq!(decoded(&valid[..valid.len() - 1]), WireError::Damaged);
    assert_eq!(
        decoded(&with_new_checksum(&|bytes| bytes[0] = VERSION + 1)),
        WireError::UnknownVersion(VERSION + 1)
    );
    assert_eq!(
        decoded(&with_new_checksum(&|bytes| bytes[0] = VERSION - 1)),
        WireError::UnknownVersion(VERSION - 1)
    );
    assert_eq!(decoded(&with_new_checksum(&|bytes| bytes[1] = 99)), WireError::Malformed);
    assert_eq!(decoded(&with_new_checksum(&|bytes| bytes.push(0))), WireError::TrailingBytes);
    type Spoil = fn(&mut ModelHeader);
    let contradictions: [(Spoil, HeaderError); 8] = [
        (|h| h.sh_degree = 4, HeaderError::ShDegree),
        (|h| h.cameras = CAMERAS_MAX + 1, HeaderError::Cameras),
        (|h| h.body_bytes = 100, HeaderError::BodyBytes),
        (|h| h.splats = u32::MAX, HeaderError::BodyBytes),
        (|h| h.chunk_bytes = 0, HeaderError::ChunkBytes),
        (|h| h.chunk_bytes = MAX_CHUNK_BYTES as u32 + 1, HeaderError::ChunkBytes),
        (|h| h.chunk_bytes = 255, HeaderError::ChunkBytes),
        (|h| h.bounds.max[1] = f32::NAN, HeaderError::Bounds),
    ];
    for (spoil, error) in contradictions {
        let mut header = header();
        spoil(&mut header);
        let bytes = Message::Header(header).encode(&mut buffer).unwrap();
        assert_eq!(decoded(bytes), WireError::Header(error));
    }
}

#[test]
fn a_body_begins_with_these_bytes() {
    let entries = [
        PackEntry {
            kind: PackKind::Cameras,
            form: PackForm::Stored,
            layer: 0,
            splats: 0,
            bytes: 96,
            crc32: 7,
        },
        PackEntry { kind: PackKind::Shapes, form: PackForm::Zstd, layer: 2, splats: 9, bytes: 150, crc32: 8 },
    ];
    let mut body = vec![0; HEAD_BYTES + 2 * PACK_ENTRY_BYTES];
    for (entry, out) in entries.iter().zip(body[HEAD_BYTES..].as_chunks_mut().0) {
        entry.encode(out);
    }
    let bounds = Bounds { min: [-1.0, 0.0, 0.5], max: [1.0, 2.0, 4.0] };
    let head = BodyHead { splats: 9, cameras: 1, sh_degree: 0, packs: 2, bounds };
    head.encode(&mut body);
    let expected = "43534742 03 00 0200 09000000 01000000".to_owned()
        + "000080bf000000000000003f0000803f0000004000008040"
        + "CHECKSUM"
        + "80 00 0000 60000000 07000000"
        + "01 02 0900 96000000 08000000";
    let checksum = hex(&body[40..44]);
    assert_eq!(hex(&body), expected.replace(' ', "").replace("CHECKSUM", &checksum));
    let plan = BodyPlan::new(&body).unwrap();
    assert_eq!((plan.head(), plan.body_bytes()), (&head, 68 + 96 + 150));
    let ranges: Vec<_> = plan.packs().map(|pack| pack.range).collect();
    assert_eq!(ranges, [68..164, 164..314]);
}

#[test]
fn shapes_have_these_planes() {
    let shape = |x: u16| Shape {
        position: [x, 258, 0],
        quat: [1022, 511, 1],
        log_scale: [5, 6],
        thickness: 7,
        opacity: -2,
        color: [3, -300, 0],
    };
    let shapes = [shape(10), shape(9)];
    let mut planes = vec![0; 2 * SHAPE_BYTES];
    write_shapes(&shapes, &mut planes);
    let expected =
        "1401 0000 0400 0200 0000 0000 ffff 7f7f 0000 1e1e 0505 0606 0707 fefe 5757 0202 5e5e 0202 5858 0202";
    assert_eq!(hex(&planes), expected.replace(' ', ""));
    assert_eq!(read_shapes(&planes).collect::<Vec<_>>(), shapes);
}

#[test]
fn changes_have_these_planes_and_turn_one_shape_into_the_other() {
    let base = Shape {
        position: [10, 2, 0],
        quat: [511, 1008, 15],
        log_scale: [5, 6],
        thickness: 7,
        opacity: -2,
        color: [3, -300, 0],
    };
    let becomes = Shape {
        position: [9, 65535, 300],
        quat: [510, 1, 1022],
        log_scale: [3, 200],
        thickness: 0,
        opacity: 127,
        color: [-32768, 5, 32767],
    };
    let change = base.change_to(&becomes);
    assert_eq!(base.changed(&change), becomes);
    let mut planes = vec![0; 2 * SHAPE_BYTES];
    write_changes(&[change, Shape::default()], &mut planes);
    let expected =
        "0100 0000 0500 0000 5800 0200 ff00 0400 fb00 3700 fe00 c200 f900 8100 6200 0200 9800 fd00 9c00 fd00";
    assert_eq!(hex(&planes), expected.replace(' ', ""));
    assert_eq!(read_changes(&planes).collect::<Vec<_>>(), [change, Shape::default()]);
}

/// Builds the head and the table of a body with these packs (kind, layer, number of splats), and returns
/// the packs of each group of splats.
fn plan_of(packs: &[(PackKind, u8, u16)]) -> Result<Vec<SplatPacks>, BodyError> {
    let mut body = vec![0; HEAD_BYTES + packs.len() * PACK_ENTRY_BYTES];
    for ((kind, layer, splats), out) in packs.iter().zip(body[HEAD_BYTES..].as_chunks_mut().0) {
        let bytes = match kind {
            PackKind::Shapes => 20 + 20 * u32::from(*splats),
            PackKind::Basis => 6 + 4 * 9 + 2 * 81,
            _ => 9 * u32::from(*splats),
        };
        let form = if *kind == PackKind::Changes { PackForm::Zstd } else { PackForm::Stored };
        PackEntry { kind: *kind, form, layer: *layer, splats: *splats, bytes, crc32: 0 }.encode(out);
    }
    let splats = packs.iter().filter(|pack| pack.0 == PackKind::Shapes).map(|pack| u32::from(pack.2)).sum();
    let bounds = Bounds { min: [0.0; 3], max: [1.0; 3] };
    BodyHead { splats, cameras: 0, sh_degree: 1, packs: packs.len() as u16, bounds }.encode(&mut body);
    BodyPlan::new(&body).map(|plan| plan.splat_packs().collect())
}

#[test]
fn each_base_pack_has_changes_and_the_other_packs_require_those_of_their_region() {
    use PackKind::{Basis, Changes, Sh, Shapes};
    let right = [
        (Basis, 0, 0),
        (Shapes, 0, 5),
        (Shapes, 0, 4),
        (Shapes, 1, 9),
        (Changes, 0, 5),
        (Sh, 0, 5),
        (Sh, 1, 9),
        (Shapes, 1, 7),
        (Shapes, 1, 6),
        (Changes, 0, 4),
        (Sh, 0, 4),
        (Sh, 1, 7),
        (Sh, 1, 6),
    ];
    let counts = |packs: &SplatPacks| {
        let splats = |pack: &Option<Pack>| pack.as_ref().map(|pack| pack.entry.splats);
        (
            packs.shapes.entry.splats,
            splats(&packs.changes),
            splats(&packs.sh),
            splats(&packs.required_changes),
        )
    };
    let plan: Vec<_> = plan_of(&right).unwrap().iter().map(counts).collect();
    assert_eq!(
        plan,
        [
            (5, Some(5), Some(5), None),
            (4, Some(4), Some(4), None),
            (9, None, Some(9), Some(5)),
            (7, None, Some(7), Some(4)),
            (6, None, Some(6), Some(4)),
        ]
    );
    type Spoil = fn(&mut Vec<(PackKind, u8, u16)>);
    let wrong: [Spoil; 5] = [
        |packs| _ = packs.remove(4),               // a base pack without a changes pack
        |packs| packs[4].2 = 4,                    // a changes pack with too few splats
        |packs| packs[4].1 = 1,                    // a changes pack in another layer
        |packs| (packs[5].1, packs[6].1) = (1, 0), // spherical harmonics in the wrong order
        |packs| packs.swap(0, 1),                  // a shapes pack before the basis
    ];
    for (i, spoil) in wrong.iter().enumerate() {
        let mut packs = right.to_vec();
        spoil(&mut packs);
        assert_eq!(plan_of(&packs), Err(BodyError::BadTable), "{i}");
    }
}

#[test]
fn spherical_harmonics_have_these_planes() {
    let layout = ShLayout { components: 4, wide: 1 }.check(1).unwrap();
    let steps = [100, -8, 7, 1, -128, 0, -1, 2];
    let mut planes = vec![0; 2 * layout.splat_bytes()];
    layout.write(&steps, &mut planes);
    assert_eq!(hex(&planes), "c8ff ef10 0204".replace(' ', ""));
    let read: Vec<i8> = (0..2)
        .flat_map(|i| (0..4).map(move |k| (i, k)))
        .map(|(i, k)| layout.read(&planes, 2, i, k))
        .collect();
    assert_eq!(read, steps);
}
