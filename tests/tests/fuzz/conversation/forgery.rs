//! Forged messages: of every kind, about what was heard and about what never was, in any voice.

use cosurf_link::body::body_hash;
use cosurf_tests::dice::Dice;
use cosurf_tests::keys::Signer;
use cosurf_wire::body::CAMERA_BYTES;
use cosurf_wire::{
    BodyHash, Bounds, CONFIRMED_FLIGHT_BYTES_MAX, CameraRecord, Chunk, ConfirmedFlights, DeviceId, Done,
    FlightCameras, FlightPledge, FrameId, Message, Missing, ModelHeader, ModelId, ModelKind, Plan,
    RefusalReason, Refused, Reply, SiteId, State, TileId, Topic, VerticalAxis, Want,
};

use super::cast::{CLOUD, GROUND, INSIDER, device, drone, site};

/// What strangers are called when they say who they are.
const STRANGER: &str = "eve";
const REASONS: [RefusalReason; 10] = [
    RefusalReason::TooLarge,
    RefusalReason::Busy,
    RefusalReason::BadBody,
    RefusalReason::NumberTaken,
    RefusalReason::StoreFailed,
    RefusalReason::Withdrawn,
    RefusalReason::WrongFrame,
    RefusalReason::Replayed,
    RefusalReason::Garbled,
    RefusalReason::TooManyDevices,
];
const REPLIES: [Reply; 5] = [Reply::Want, Reply::Done, Reply::Refused, Reply::Flight, Reply::Plan];
const KINDS: [ModelKind; 4] =
    [ModelKind::Local, ModelKind::Global, ModelKind::Compressed, ModelKind::Manifest];

pub(crate) fn pick<T: Copy>(dice: &mut Dice, from: &[T]) -> T {
    from[dice.below(from.len())]
}

/// How a forged message is sealed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Voice {
    /// Not at all.
    Plain,
    /// With a key that nobody lists.
    Stranger,
    /// In the name of an honest participant, with the wrong key.
    Pretender,
    /// With the listed key of the hostile participant.
    Insider,
}

/// A model that was heard of: where, and in which session of its sender.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Target {
    pub(crate) site: SiteId,
    pub(crate) header: ModelHeader,
    pub(crate) session: u64,
}

thread_local! {
    static KEYS: [Signer; 2] = [Signer::of(STRANGER), Signer::of(INSIDER)];
}

/// Encodes a message in a voice. `count` numbers the messages of the insider.
pub(crate) fn voiced(
    dice: &mut Dice,
    voice: Voice,
    topic: &str,
    message: &Message<'_>,
    count: &mut u64,
) -> Vec<u8> {
    *count += 1;
    // Also too late, too early, and as late as it goes.
    let session = pick(dice, &[1, 1000, 1001, 1002, 2000, u64::MAX]);
    let count = pick(dice, &[*count, *count, *count, 0, u64::MAX]);
    KEYS.with(|[stranger, insider]| match voice {
        Voice::Plain => {
            let mut out = vec![0; message.bytes_max()];
            let used = message.encode(&mut out).unwrap().len();
            out.truncate(used);
            out
        }
        Voice::Stranger => stranger.seal(topic, message, session, count),
        Voice::Pretender => {
            let name = somebody(dice);
            stranger.seal_as(name, topic, message, session, count)
        }
        Voice::Insider => insider.seal(topic, message, session, count),
    })
}

/// A participant, honest or not, known or not.
pub(crate) fn somebody(dice: &mut Dice) -> DeviceId {
    match dice.below(8) {
        0 => device(GROUND),
        1 => device(CLOUD),
        2 => device(INSIDER),
        3 => device(STRANGER),
        4 => device(&format!("ghost-{}", dice.below(40))),
        _ => device(&drone(1 + dice.below(3))),
    }
}

/// A number of a model: the genuine one, its neighbours, or an extreme one.
pub(crate) fn number(dice: &mut Dice, near: ModelId) -> ModelId {
    let ModelId(near) = near;
    ModelId(match dice.below(8) {
        0 => u64::MAX,
        1 => 1 << 63,
        2 => (1 << 63) - 1,
        3 => 0,
        4 => near.wrapping_add(1),
        5 => dice.below(9) as u64,
        _ => near,
    })
}

/// A header like that of the target, with some other fields. Most such headers are consistent.
pub(crate) fn header(dice: &mut Dice, target: &Target) -> ModelHeader {
    let mut header = target.header;
    for _ in 0..1 + dice.below(3) {
        match dice.below(9) {
            0 => header.device = somebody(dice),
            1 => header.model = number(dice, header.model),
            2 => header.kind = pick(dice, &KINDS),
            3 => header.frame = FrameId::new("moon").unwrap(),
            4 => header.blake3 = BodyHash([dice.bits() as u8; 32]),
            5 => header.chunk_bytes = pick(dice, &[256, 300, 512, 1024, 65_536, 1, 0, u32::MAX]),
            6 => (header.splats, header.body_bytes) = (600, 600 * 12 + dice.below(3000) as u64),
            7 => (header.splats, header.body_bytes) = (u32::MAX, 1 << pick(dice, &[20, 30, 36, 63])),
            _ => header.bounds = Bounds { min: [f32::NAN; 3], max: [1e30; 3] },
        }
    }
    header
}

/// A camera that may be unusable.
fn camera(dice: &mut Dice) -> [u8; CAMERA_BYTES] {
    let wild = pick(dice, &[1.0, 0.0, f64::NAN, 1e300, -1.0]);
    let camera = CameraRecord {
        quat: [1.0, 0.0, 0.0, 0.0],
        translation: [1.0, 2.0, wild],
        focal_px: [500.0, 500.0],
        center_px: [320.0, 240.0],
        size_px: [pick(dice, &[640, 640, 0, u32::MAX]), 480],
    };
    let mut bytes = [0; CAMERA_BYTES];
    camera.encode(&mut bytes);
    bytes
}

/// What a forged message may borrow.
#[derive(Debug, Default)]
pub(crate) struct Scratch(Vec<u8>);

/// A message of any kind about a target, and a topic for it, usually the right one.
pub(crate) fn message<'a>(
    dice: &mut Dice,
    target: &Target,
    scratch: &'a mut Scratch,
) -> (SiteId, Topic, Message<'a>) {
    let at = if dice.below(8) == 0 { site(dice.below(2)) } else { target.site };
    let (topic, message) = statement(dice, target, scratch);
    let topic = if dice.below(8) == 0 { any_topic(dice, target) } else { topic };
    (at, topic, message)
}

fn statement<'a>(dice: &mut Dice, target: &Target, scratch: &'a mut Scratch) -> (Topic, Message<'a>) {
    let ModelHeader { device, model, blake3, .. } = target.header;
    let session = pick(dice, &[target.session, target.session, 0, 1000, u64::MAX]);
    let topic = |dice: &mut Dice, reply| match dice.below(3) {
        0 => Topic::GlobalReply { device: somebody(dice), reply },
        _ => Topic::LocalReply { device, reply },
    };
    match dice.below(10) {
        0 => {
            let blake3 = if dice.below(4) == 0 { BodyHash([0; 32]) } else { blake3 };
            (topic(dice, Reply::Done), Message::Done(Done { device, model, session, blake3 }))
        }
        1 => {
            let reason = pick(dice, &REASONS);
            (topic(dice, Reply::Refused), Message::Refused(Refused { device, model, session, reason }))
        }
        2 | 3 => {
            let share = dice.below(5) as u32;
            let missing = match dice.below(3) {
                0 => Missing::all(),
                _ => Missing::of(target.header.chunks().min(2000), |i| {
                    i.wrapping_mul(2_654_435_761) % 4 < share
                }),
            };
            let idle = dice.coin();
            (topic(dice, Reply::Want), Message::Want(Want { device, model, session, idle, missing }))
        }
        4 => {
            let device = somebody(dice);
            let state = State { device, session: pick(dice, &[session, 999, 5000]), alive: dice.coin() };
            (Topic::State { device }, Message::State(state))
        }
        5 if dice.below(3) == 0 => {
            let device = somebody(dice);
            let corner = |i: usize| Plan::encode_corner([(i % 2) as f64, (i % 3) as f64]);
            scratch.0 = (0..pick(dice, &[0, 3, 64, 2, 65])).flat_map(corner).collect();
            let (margin, frame) = (pick(dice, &[0.0, 1.0, -1.0, f64::NAN]), FrameId::default());
            let vertical = VerticalAxis::X;
            let plan = Plan { device, session, frame, vertical, margin, cell: &scratch.0 };
            (Topic::LocalReply { device, reply: Reply::Plan }, Message::Plan(plan))
        }
        5 if dice.coin() => {
            let reply = Reply::Flight;
            let listed = if dice.coin() { somebody(dice) } else { device };
            if dice.coin() {
                let pledge = FlightPledge { device: listed, session, cameras_blake3: blake3 };
                return (Topic::GlobalReply { device: listed, reply }, Message::FlightPledge(pledge));
            }
            let out = &mut [0; CONFIRMED_FLIGHT_BYTES_MAX];
            scratch.0 = ConfirmedFlights::encode_flight(listed, blake3, out).repeat(dice.below(3));
            let (first, total) = pick(dice, &[(0, 1), (0, 2), (0, 0), (1, 3), (0, u32::MAX)]);
            let list = ConfirmedFlights { device, session, first, total, flights: &scratch.0 };
            (Topic::LocalReply { device, reply }, Message::ConfirmedFlights(list))
        }
        5 => {
            let device = somebody(dice);
            scratch.0 = (0..dice.below(4)).flat_map(|_| camera(dice)).collect();
            let flight = FlightCameras { device, frame: FrameId::default(), cameras: &scratch.0 };
            (Topic::Flight { device }, Message::Flight(flight))
        }
        6 | 7 => {
            let header = header(dice, target);
            (topic_of(dice, &header), Message::Header(header))
        }
        _ => {
            let index = dice.below(1 + target.header.chunks().min(300) as usize) as u32;
            let range = target.header.chunk_range(index).unwrap_or(0..77);
            let bytes = if dice.below(8) == 0 { dice.below(3000) as u64 } else { range.end - range.start };
            scratch.0 = vec![dice.bits() as u8; bytes.min(65_536) as usize];
            let chunk = Chunk { device, model, index, payload: &scratch.0 };
            (chunk_topic(&target.header, index), Message::Chunk(chunk))
        }
    }
}

/// The topic for a header.
pub(crate) fn topic_of(dice: &mut Dice, header: &ModelHeader) -> Topic {
    let ModelHeader { device, model, kind, .. } = *header;
    match kind {
        ModelKind::Local | ModelKind::Compressed => Topic::LocalHeader { device, model },
        _ if model.is_tile() => Topic::TileHeader { device: self::device(&drone(1 + dice.below(3))), model },
        ModelKind::Global | ModelKind::Manifest => Topic::GlobalHeader { tile: TileId::WHOLE },
    }
}

/// The topic for a chunk of a model.
pub(crate) fn chunk_topic(header: &ModelHeader, index: u32) -> Topic {
    let ModelHeader { device, model, kind, .. } = *header;
    match kind {
        ModelKind::Local | ModelKind::Compressed => Topic::LocalChunk { device, model, index },
        ModelKind::Global | ModelKind::Manifest => Topic::GlobalChunk { tile: TileId::WHOLE, model, index },
    }
}

fn any_topic(dice: &mut Dice, target: &Target) -> Topic {
    let (device, model, index) = (somebody(dice), target.header.model, dice.below(4) as u32);
    let (tile, reply) = (TileId::WHOLE, pick(dice, &REPLIES));
    match dice.below(10) {
        0 => Topic::State { device },
        1 => Topic::Flight { device },
        2 => Topic::LocalHeader { device, model },
        3 => Topic::LocalChunk { device, model, index },
        4 => Topic::LocalReply { device, reply },
        5 => Topic::TileHeader { device, model },
        6 => Topic::TileChunk { device, model, index },
        7 => Topic::GlobalHeader { tile },
        8 => Topic::GlobalChunk { tile, model, index },
        _ => Topic::GlobalReply { device, reply },
    }
}

/// A header for a body that is no model, with the right hash.
pub(crate) fn header_of_junk(dice: &mut Dice, target: &Target) -> (ModelHeader, Vec<u8>) {
    let body = vec![dice.bits() as u8; target.header.body_bytes as usize];
    (ModelHeader { blake3: body_hash(&body), ..target.header }, body)
}
