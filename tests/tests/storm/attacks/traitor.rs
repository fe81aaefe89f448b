//! Drones with genuine keys that do harm.

use std::io;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use cosurf_link::body::body_hash;
use cosurf_link::{
    Credentials, Identity, InboxLimits, Login, MqttConfig, MqttTransport, Node, NodeEvent, Offer, Role,
    upload_blocking,
};
use cosurf_scene::{Camera, Pose, Splats};
use cosurf_tests::dice::Dice;
use cosurf_tests::models::random_splats;
use cosurf_tests::mqtt::publish;
use cosurf_tests::offers::broker_address;
use cosurf_wire::message::{Chunk, Want};
use cosurf_wire::{
    DeviceId, FrameId, MAX_CHUNK_BYTES, Message, Missing, ModelHeader, ModelId, ModelKind, Reply, SiteId,
    Topic,
};
use ed25519_dalek::SigningKey;
use glam::{DVec2, DVec3};

use crate::act::Act;
use crate::field::{Field, SIGNERS, SITE, TRAITOR, device, encode, sealed, text};
use crate::line::Line;

/// The largest picture that a camera may claim.
const HUGE_PX: [u32; 2] = [16_384, 16_384];
/// Distance to the ground of the honest drones, for models that share none with them.
const FAR_M: f32 = 10_000.0;
/// Size of each of the models that a drone hoards: four are a quarter of the aggregator's memory for models.
const HOARD_BYTES: u64 = 4_000_000;
/// An upload without an answer for this long is followed by the next one.
const IMPATIENCE: Duration = Duration::from_secs(3);

/// A drone of the storm that is a client like an honest one.
struct Traitor {
    node: Node,
    transport: MqttTransport,
    begun: Instant,
}

impl Traitor {
    fn new(field: &Field) -> Self {
        let site = SiteId::new(SITE).unwrap();
        let identity = Identity { site, device: device(TRAITOR), session: clock_s(), role: Role::Device };
        let own = field.keys.join(TRAITOR);
        let [key, trusted] = ["sign.key", "trusted.txt"].map(|file| own.join(file));
        let credentials = Credentials::load(FrameId::default(), Some(&key), Some(&trusted), None).unwrap();
        let mut node = Node::new(identity, InboxLimits::default(), &[]);
        node.set_credentials(credentials);
        let login =
            field.login.map(|(user, password)| Login { user: user.into(), password: password.into() });
        let broker = broker_address(field.address);
        let transport = MqttTransport::start(MqttConfig { broker, identity, will: None, tls: None, login });
        Self { node, transport, begun: Instant::now() }
    }

    /// Takes part for a moment; returns whether a model was acknowledged or refused.
    fn step(&mut self) -> bool {
        let until = Instant::now() + Duration::from_millis(100);
        while Instant::now() < until {
            let begun = self.begun;
            match self.node.step(&mut self.transport, || begun.elapsed(), Duration::from_millis(20)) {
                Some(NodeEvent::Uploaded(..) | NodeEvent::UploadRefused { .. }) => return true,
                Some(NodeEvent::Store { header, .. }) => self.node.store_failed((&header).into()),
                _ => {}
            }
        }
        false
    }
}

/// Sends a model that shares no ground with those of the other drones, and waits until it is acknowledged.
pub(crate) fn send_a_far_model(field: &Field, seed: u64) {
    let Traitor { mut node, mut transport, begun } = Traitor::new(field);
    let offer =
        offer(next_number(), &moved(random_splats(seed, 30, 0)), &[above(FAR_M.into(), 0.0, [96, 72])]);
    upload_blocking(&mut node, &mut transport, offer, || begun.elapsed(), |_, _| ()).unwrap();
}

/// Model after model: elsewhere or on the honest drones' ground, with huge pictures, giant splats, or damaged bodies.
pub(super) fn models<'a>(field: &'a Field, _: &mut Dice) -> io::Result<Act<'a>> {
    let mut traitor = Traitor::new(field);
    let mut number = next_number();
    let mut sent: Option<Instant> = None;
    Ok(Box::new(move |dice| {
        if sent.is_none_or(|at| at.elapsed() > IMPATIENCE) {
            number = ModelId(number.0 + 1);
            traitor.node.upload(evil(dice, number));
            sent = Some(Instant::now());
        }
        let is_answered = traitor.step();
        if is_answered {
            sent = None;
        }
        Ok(u64::from(is_answered))
    }))
}

fn evil(dice: &mut Dice, number: ModelId) -> Offer {
    let splats = random_splats(dice.bits(), 20 + dice.below(2000), 0);
    let (far, here) = (f64::from(FAR_M), 60.0 * dice.unit() - 30.0);
    match dice.below(6) {
        0 => offer(number, &moved(splats), &[above(far, 0.0, [96, 72])]),
        1 => offer(number, &moved(splats), &[above(far, 0.0, HUGE_PX)]),
        2 => offer(number, &splats, &[above(here, 0.0, [96, 72]), above(0.0, here, [96, 72])]),
        3 => offer(number, &splats, &[above(here, here, HUGE_PX)]),
        4 => {
            let mut giants = splats;
            giants.log_scales.iter_mut().flatten().for_each(|scale| *scale += 4.0);
            offer(number, &giants, &[above(here, here, [96, 72])])
        }
        _ => {
            let mut offer = offer(number, &splats, &[above(here, here, [96, 72])]);
            let place = dice.below(offer.body.len());
            offer.body[place] ^= 1 << dice.below(8);
            offer.header.blake3 = body_hash(&offer.body);
            offer
        }
    }
}

fn offer(number: ModelId, splats: &Splats, cameras: &[Camera]) -> Offer {
    Offer::new(device(TRAITOR), number, ModelKind::Local, 3, splats, cameras).unwrap()
}

fn moved(mut splats: Splats) -> Splats {
    splats.means.iter_mut().for_each(|mean| mean[0] += FAR_M);
    splats
}

/// A camera that looks down from a height of 60 m.
fn above(x: f64, y: f64, size_px: [u32; 2]) -> Camera {
    Camera {
        cam_from_world: Pose::look_at(DVec3::new(x, y, 60.0), DVec3::new(x, y, 0.0), DVec3::Y),
        focal_px: DVec2::splat(f64::from(size_px[0])),
        center_px: DVec2::new(f64::from(size_px[0]), f64::from(size_px[1])) / 2.0,
        size_px,
    }
}

/// A drone that signs messages itself.
struct Signer<'a> {
    field: &'a Field,
    line: Line,
    name: DeviceId,
    key: SigningKey,
    /// Session and number of the last message.
    at: (u64, u64),
    small: ModelHeader,
}

impl<'a> Signer<'a> {
    fn new(field: &'a Field, dice: &mut Dice, name: &str) -> io::Result<Self> {
        let line = field.join(&format!("{name}-{}", dice.bits()))?;
        let small = offer(ModelId(1), &random_splats(1, 20, 0), &[]).header;
        let (key, name) = (field.key_of(name), device(name));
        Ok(Self { field, line, name, key, at: (clock_s(), 0), small })
    }

    fn say(&mut self, topic: Topic, message: &Message<'_>) -> io::Result<()> {
        self.at.1 += 1;
        self.line.discard()?;
        let payload = match message {
            Message::Chunk(_) => encode(message),
            _ => sealed(&self.key, self.name, self.at, topic, message),
        };
        self.line.send(&publish(&text(topic), &payload, 1, false, &[]))
    }

    /// Announces a model of 4 MB.
    fn announce(&mut self, model: ModelId, chunk_bytes: u32) -> io::Result<()> {
        let device = self.name;
        let sizes = ModelHeader { splats: 200_000, body_bytes: HOARD_BYTES, chunk_bytes, ..self.small };
        let header = ModelHeader { device, model, ..sizes };
        self.say(Topic::LocalHeader { device, model }, &Message::Header(header))
    }

    fn send_junk(&mut self, model: ModelId, index: u32, payload: &[u8]) -> io::Result<()> {
        let device = self.name;
        let chunk = Chunk { device, model, index, payload };
        self.say(Topic::LocalChunk { device, model, index }, &Message::Chunk(chunk))
    }

    /// Asks for all or half of the newest global model.
    fn want(&mut self, dice: &mut Dice) -> io::Result<()> {
        let is_global = |(_, header, _): &(Topic, ModelHeader, u64)| header.kind == ModelKind::Global;
        let Some((_, header, _)) = self.field.headers().into_iter().find(is_global) else { return Ok(()) };
        let missing = if dice.coin() { Missing::all() } else { Missing::of(header.chunks(), |i| i % 2 == 0) };
        let want = Want { device: header.device, model: header.model, session: 0, idle: true, missing };
        self.say(Topic::GlobalReply { device: self.name, reply: Reply::Want }, &Message::Want(want))
    }
}

/// As much memory as a drone gets for its uploads: four models at once, whose bodies arrive and have the wrong hash.
pub(super) fn hoards<'a>(field: &'a Field, dice: &mut Dice) -> io::Result<Act<'a>> {
    let signers: io::Result<Vec<Signer>> =
        SIGNERS[1..].iter().map(|name| Signer::new(field, dice, name)).collect();
    let (mut signers, mut acts) = (signers?, 0);
    Ok(Box::new(move |dice| {
        let junk = vec![dice.bits() as u8; MAX_CHUNK_BYTES];
        let (model, index) =
            (ModelId(1 + acts % 4), (acts / 4 % HOARD_BYTES.div_ceil(MAX_CHUNK_BYTES as u64)) as u32);
        let left = HOARD_BYTES as usize - index as usize * MAX_CHUNK_BYTES;
        for signer in &mut signers {
            if acts % 100 < 4 {
                signer.announce(model, MAX_CHUNK_BYTES as u32)?;
            }
            signer.send_junk(model, index, &junk[..left.min(MAX_CHUNK_BYTES)])?;
        }
        acts += 1;
        Ok(signers.len() as u64)
    }))
}

/// Announcements under any number and with tiny chunks, and requests for global models.
pub(super) fn signed_words<'a>(field: &'a Field, dice: &mut Dice) -> io::Result<Act<'a>> {
    let mut signer = Signer::new(field, dice, SIGNERS[0])?;
    Ok(Box::new(move |dice| {
        let model = ModelId([signer.at.1, dice.bits() >> 1, (1 << 63) - 1, u64::MAX][dice.below(4)]);
        let chunk_bytes = [1, 1024, 65_536][dice.below(3)];
        signer.announce(model, chunk_bytes)?;
        signer.send_junk(model, dice.below(300) as u32, &vec![7; chunk_bytes as usize])?;
        signer.want(dice)?;
        Ok(3)
    }))
}

/// A number higher than those of earlier models.
fn next_number() -> ModelId {
    ModelId(clock_s() << 16)
}

fn clock_s() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_secs()
}
