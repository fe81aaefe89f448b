//! Forged words: messages of the protocol that no honest participant has said.

use std::io;

use cosurf_link::Offer;
use cosurf_tests::dice::Dice;
use cosurf_tests::models::{cameras, random_splats};
use cosurf_tests::mqtt::publish;
use cosurf_wire::message::{Chunk, Done, Refused, Want};
use cosurf_wire::{
    BodyHash, DeviceId, FlightCameras, FrameId, Message, Missing, ModelHeader, ModelId, ModelKind,
    RefusalReason, Reply, State, TileId, Topic,
};
use ed25519_dalek::SigningKey;

use crate::act::Act;
use crate::field::{Field, GROUND, SIGNERS, SITE, device, encode, sealed, text};
use crate::line::Line;

/// An attacker who forges messages: without a seal, with a key of its own, or with the key of another participant.
struct Forger<'a> {
    field: &'a Field,
    line: Line,
    own: SigningKey,
    of_signer: SigningKey,
    count: u64,
}

impl<'a> Forger<'a> {
    fn new(field: &'a Field, dice: &mut Dice) -> io::Result<Self> {
        let line = field.join(&format!("forger-{}", dice.bits()))?;
        let own = SigningKey::from_bytes(&std::array::from_fn(|_| dice.bits() as u8));
        Ok(Self { field, line, own, of_signer: field.key_of(SIGNERS[0]), count: 1 << 40 })
    }

    /// Sends a message that `speaker` seems to have sent.
    fn say(
        &mut self,
        dice: &mut Dice,
        topic: Topic,
        message: &Message<'_>,
        speaker: DeviceId,
    ) -> io::Result<()> {
        self.count += 1;
        let at = ([u64::MAX, 1 << 40, 7][dice.below(3)], self.count);
        let payload = match (message, dice.below(4)) {
            (Message::Chunk(_), _) | (_, 0) => encode(message),
            (_, 1) => sealed(&self.own, speaker, at, topic, message),
            (_, 2) => sealed(&self.of_signer, speaker, at, topic, message),
            _ => sealed(&self.of_signer, device(SIGNERS[0]), at, topic, message),
        };
        self.send(dice, &text(topic), &payload)
    }

    fn send(&mut self, dice: &mut Dice, topic: &str, payload: &[u8]) -> io::Result<()> {
        self.line.discard()?;
        self.line.send(&publish(topic, payload, dice.below(2) as u8, dice.below(4) == 0, &[]))
    }

    /// A header that a drone has sent, with its topic and session, or one that was made up.
    fn header(&self, dice: &mut Dice) -> (Topic, ModelHeader, u64) {
        let mut heard = self.field.headers();
        if !heard.is_empty() && dice.below(4) > 0 {
            return heard.swap_remove(dice.below(heard.len()));
        }
        let device = self.field.victim(dice);
        let header = ModelHeader { device, ..small_header(dice) };
        (Topic::LocalHeader { device, model: header.model }, header, 7)
    }
}

/// The header of a small model.
fn small_header(dice: &mut Dice) -> ModelHeader {
    let splats = random_splats(1, 20, 0);
    let offer = Offer::new(device("x"), ModelId(1), ModelKind::Local, 3, &splats, &cameras(3)).unwrap();
    ModelHeader { blake3: BodyHash(std::array::from_fn(|_| dice.bits() as u8)), ..offer.header }
}

/// A header that claims 20 MB.
fn large_header(dice: &mut Dice, device: DeviceId) -> ModelHeader {
    let header = small_header(dice);
    ModelHeader { device, splats: 1_000_000, body_bytes: 20_000_000, ..header }
}

/// Begins an attack that forges messages.
fn forge<'a>(
    field: &'a Field,
    dice: &mut Dice,
    mut act: impl FnMut(&mut Forger<'a>, &mut Dice) -> io::Result<u64> + 'a,
) -> io::Result<Act<'a>> {
    let mut forger = Forger::new(field, dice)?;
    Ok(Box::new(move |dice| act(&mut forger, dice)))
}

fn reply(dice: &mut Dice, header: &ModelHeader, session: u64) -> (Reply, Message<'static>) {
    let (device, model, blake3) = (header.device, header.model, header.blake3);
    let session = if dice.coin() { session } else { 0 };
    let reasons =
        [RefusalReason::Withdrawn, RefusalReason::NumberTaken, RefusalReason::TooLarge, RefusalReason::Busy];
    match dice.below(3) {
        0 => (Reply::Done, Message::Done(Done { device, model, session, blake3 })),
        1 => {
            let reason = reasons[dice.below(reasons.len())];
            (Reply::Refused, Message::Refused(Refused { device, model, session, reason }))
        }
        _ => {
            let missing =
                if dice.coin() { Missing::all() } else { Missing::of(header.chunks(), |i| i % 2 == 0) };
            (Reply::Want, Message::Want(Want { device, model, session, idle: dice.coin(), missing }))
        }
    }
}

/// Done, Refused and Want for the drones' uploads.
pub(super) fn replies<'a>(field: &'a Field, dice: &mut Dice) -> io::Result<Act<'a>> {
    forge(field, dice, |forger, dice| {
        let (_, header, session) = forger.header(dice);
        let (kind, message) = reply(dice, &header, session);
        let topic = Topic::LocalReply { device: header.device, reply: kind };
        forger.say(dice, topic, &message, device(GROUND)).map(|()| 1)
    })
}

/// The same for the global model, in the drones' names.
pub(super) fn global_replies<'a>(field: &'a Field, dice: &mut Dice) -> io::Result<Act<'a>> {
    forge(field, dice, |forger, dice| {
        let (_, header, session) = forger.header(dice);
        let (kind, message) = reply(dice, &header, session);
        let speaker = forger.field.victim(dice);
        forger.say(dice, Topic::GlobalReply { device: speaker, reply: kind }, &message, speaker).map(|()| 1)
    })
}

/// Headers in the place of genuine ones, and under the highest number.
pub(super) fn headers<'a>(field: &'a Field, dice: &mut Dice) -> io::Result<Act<'a>> {
    forge(field, dice, |forger, dice| {
        let (topic, header, _) = forger.header(dice);
        let speaker = header.device;
        let number =
            if dice.coin() { header.model } else { ModelId([u64::MAX, (1 << 63) - 1, 2][dice.below(3)]) };
        let forged = match dice.below(3) {
            0 => ModelHeader { chunk_bytes: [1, 1024, 65_536][dice.below(3)], ..header },
            1 => ModelHeader { model: number, ..large_header(dice, speaker) },
            _ => ModelHeader { device: speaker, model: number, ..small_header(dice) },
        };
        let topic = match topic {
            Topic::LocalHeader { device, .. } => Topic::LocalHeader { device, model: forged.model },
            topic => topic,
        };
        forger.say(dice, topic, &Message::Header(forged), speaker).map(|()| 1)
    })
}

/// Chunks of nothing, for a model that is on its way.
pub(super) fn chunks_for_victims<'a>(field: &'a Field, dice: &mut Dice) -> io::Result<Act<'a>> {
    forge(field, dice, |forger, dice| {
        let (topic, header, _) = forger.header(dice);
        let index = dice.below(header.chunks() as usize) as u32;
        let length = header.chunk_range(index).map_or(0, |range| (range.end - range.start) as usize);
        junk_chunk(forger, dice, topic, &header, (index, length))
    })
}

fn junk_chunk(
    forger: &mut Forger<'_>,
    dice: &mut Dice,
    of: Topic,
    header: &ModelHeader,
    (index, length): (u32, usize),
) -> io::Result<u64> {
    let ModelHeader { device, model, .. } = *header;
    let junk = vec![dice.bits() as u8; length];
    let topic = match of {
        Topic::GlobalHeader { tile } => Topic::GlobalChunk { tile, model, index },
        _ => Topic::LocalChunk { device, model, index },
    };
    forger
        .say(dice, topic, &Message::Chunk(Chunk { device, model, index, payload: &junk }), device)
        .map(|()| 1)
}

/// Messages that are none, and those of another version, under the topics of many names.
pub(super) fn bad_messages<'a>(field: &'a Field, dice: &mut Dice) -> io::Result<Act<'a>> {
    forge(field, dice, |forger, dice| {
        for _ in 0..40 {
            let name = if dice.coin() {
                forger.field.victim(dice)
            } else {
                device(&format!("n{}", dice.below(2000)))
            };
            let topic = Topic::LocalHeader { device: name, model: ModelId(dice.bits() >> dice.below(64)) };
            let mut payload: Vec<u8> = (0..5).map(|_| dice.bits() as u8).collect();
            payload[0] = [2, 3, 4, 255][dice.below(4)];
            if dice.coin() {
                payload.extend(crc32fast::hash(&payload).to_le_bytes());
            }
            forger.send(dice, &text(topic), &payload)?;
        }
        Ok(40)
    })
}

/// Announcements of large models by many names, and a few chunks of them.
pub(super) fn reservations<'a>(field: &'a Field, dice: &mut Dice) -> io::Result<Act<'a>> {
    forge(field, dice, |forger, dice| {
        let name = device(&format!("r{}", dice.below(500)));
        let header = large_header(dice, name);
        let topic = Topic::LocalHeader { device: header.device, model: header.model };
        forger.say(dice, topic, &Message::Header(header), header.device)?;
        if dice.coin() {
            let place = (dice.below(64) as u32, header.chunk_bytes as usize);
            junk_chunk(forger, dice, topic, &header, place)?;
        }
        Ok(1)
    })
}

/// Flights of drones that do not exist, and of those that do.
pub(super) fn flights<'a>(field: &'a Field, dice: &mut Dice) -> io::Result<Act<'a>> {
    forge(field, dice, |forger, dice| {
        let name =
            if dice.coin() { forger.field.victim(dice) } else { device(&format!("g{}", dice.below(50))) };
        let flight = FlightCameras { device: name, frame: FrameId::default(), cameras: &[] };
        forger.say(dice, Topic::Flight { device: name }, &Message::Flight(flight), name).map(|()| 1)
    })
}

/// Global models of nobody, under high revisions.
pub(super) fn globals<'a>(field: &'a Field, dice: &mut Dice) -> io::Result<Act<'a>> {
    forge(field, dice, |forger, dice| {
        let kind = if dice.coin() { ModelKind::Global } else { ModelKind::Manifest };
        let model = ModelId(1 + dice.bits() % 1_000_000);
        let header = ModelHeader { device: device(GROUND), model, kind, ..small_header(dice) };
        let topic = Topic::GlobalHeader { tile: TileId::WHOLE };
        forger.say(dice, topic, &Message::Header(header), device(GROUND))?;
        junk_chunk(forger, dice, topic, &header, (0, 1000))?;
        Ok(2)
    })
}

/// Deletes what is retained under the topics of the drones and of the global model.
pub(super) fn clear_retained<'a>(field: &'a Field, dice: &mut Dice) -> io::Result<Act<'a>> {
    forge(field, dice, |forger, dice| {
        let device = forger.field.victim(dice);
        let topic = match dice.below(4) {
            0 => Topic::GlobalHeader { tile: TileId::WHOLE },
            1 => Topic::State { device },
            2 => Topic::Flight { device },
            _ => Topic::LocalHeader { device, model: ModelId(1) },
        };
        forger.line.discard()?;
        forger.line.send(&publish(&text(topic), &[], 0, true, &[])).map(|()| 1)
    })
}

/// Topics that would write lines of their own, or colours, into a log.
pub(super) fn topics<'a>(field: &'a Field, dice: &mut Dice) -> io::Result<Act<'a>> {
    forge(field, dice, |forger, dice| {
        let level =
            ["x\nglobal model, revision 9", "\u{1b}[2J", "\u{9b}1m", "\u{202e}x", "..", ""][dice.below(6)];
        let tail = ["state", "up/1/m", "up/1/c/0", "global/want"][dice.below(4)];
        forger.send(dice, &format!("gs/v1/{SITE}/{level}/{tail}"), b"x").map(|()| 1)
    })
}

/// Starts and ends of sessions of the aggregator and the drones.
pub(super) fn states<'a>(field: &'a Field, dice: &mut Dice) -> io::Result<Act<'a>> {
    forge(field, dice, |forger, dice| {
        let speaker = if dice.coin() { forger.field.victim(dice) } else { device(GROUND) };
        let session = [u64::MAX, 0, dice.bits()][dice.below(3)];
        let state = State { device: speaker, session, alive: dice.coin() };
        forger.say(dice, Topic::State { device: speaker }, &Message::State(state), speaker).map(|()| 1)
    })
}
