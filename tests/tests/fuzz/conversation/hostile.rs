//! A hostile participant. It hears everything, remembers some of it, and acts by a grammar: it repeats, sends elsewhere,
//! damages and forges messages, one at a time, in sequences and in floods.

use std::collections::BTreeMap;
use std::time::Duration;

use cosurf_link::{MemoryNetwork, MemoryTransport, Offer, Outgoing, Transport, TransportEvent};
use cosurf_tests::dice::Dice;
use cosurf_tests::mutate::mutated;
use cosurf_wire::{Chunk, DeviceId, Message, ModelHeader, ModelId, ModelKind, Seal, Sealed, SiteId, Topic};

use super::cast::{INSIDER, device, model, site};
use super::forgery::{
    Scratch, Target, Voice, chunk_topic, header, header_of_junk, message, number, pick, somebody, topic_of,
    voiced,
};
use super::plan::{Mode, Plan};

/// Number of messages that a hostile participant remembers.
const HEARD_MAX: usize = 40;
/// Number of models that it remembers.
const TARGETS_MAX: usize = 6;

/// A hostile participant.
pub(crate) struct Hostile {
    transport: MemoryTransport,
    dice: Dice,
    mode: Mode,
    has_key: bool,
    chunk_bytes: u32,
    heard: Vec<(String, Vec<u8>)>,
    targets: Vec<Target>,
    /// What it is about to say, by time and number.
    plans: BTreeMap<(Duration, u64), Outgoing>,
    planned: u64,
    /// Number of its sealed messages.
    count: u64,
    next_act: Duration,
    pause: Duration,
    until: Duration,
    /// Number of messages that it has said.
    pub(crate) said: u64,
}

impl Hostile {
    pub(crate) fn new(network: &MemoryNetwork, plan: &Plan, mut dice: Dice) -> Self {
        let next_act = Duration::from_millis(dice.below(500) as u64);
        Self {
            transport: network.join_all(),
            dice,
            mode: plan.mode,
            has_key: plan.has_insider && plan.mode == Mode::Signed,
            chunk_bytes: plan.chunk_bytes,
            heard: Vec::new(),
            targets: Vec::new(),
            plans: BTreeMap::new(),
            planned: 0,
            count: 0,
            next_act,
            pause: plan.pause,
            until: plan.attack,
            said: 0,
        }
    }

    /// When the participant next does something of its own accord.
    pub(crate) fn next_wakeup(&self) -> Option<Duration> {
        let planned = self.plans.keys().next().map(|(at, _)| *at);
        planned.into_iter().chain((self.next_act < self.until).then_some(self.next_act)).min()
    }

    /// Whether it has nothing more to say.
    pub(crate) fn is_over(&self, now: Duration) -> bool {
        now >= self.until && self.plans.is_empty()
    }

    /// Listens, acts, and says what is due.
    pub(crate) fn work(&mut self, now: Duration) {
        self.listen(now);
        while self.next_act <= now && self.next_act < self.until {
            self.act(now);
            self.next_act =
                now + Duration::from_micros(1 + self.dice.below(self.pause.as_micros() as usize) as u64);
        }
        while let Some(first) = self.plans.first_entry()
            && first.key().0 <= now
        {
            let outgoing = first.remove();
            self.said += u64::from(self.transport.publish(&outgoing).is_ok());
        }
    }

    fn listen(&mut self, now: Duration) {
        while let Some(event) = self.transport.poll(Duration::ZERO) {
            let TransportEvent::Incoming { topic, payload } = event else { continue };
            self.learn(&topic, &payload);
            if self.targets.is_empty() || now >= self.until {
                continue;
            }
            if self.dice.below(16) == 0 {
                self.forge(now);
            }
            if self.heard.len() < HEARD_MAX {
                self.heard.push((topic, payload));
            } else if self.dice.below(3) == 0 {
                let place = self.dice.below(HEARD_MAX);
                self.heard[place] = (topic, payload);
            }
        }
    }

    /// Remembers the models that were announced.
    fn learn(&mut self, topic: &str, payload: &[u8]) {
        let Ok((site, _)) = Topic::parse(topic) else { return };
        let Ok(Sealed { message: Message::Header(header), seal, .. }) = Sealed::decode(payload) else {
            return;
        };
        let session = seal.map_or(0, |Seal { session, .. }| session);
        let target = Target { site, header, session };
        let known = self.targets.iter().position(|known| known.header == header);
        match known {
            None if self.targets.len() < TARGETS_MAX => self.targets.push(target),
            known => {
                let place = known.unwrap_or_else(|| self.dice.below(TARGETS_MAX));
                self.targets[place] = target;
            }
        }
    }

    /// A model that was announced, or one that the participant makes up.
    fn target(&mut self) -> Target {
        if !self.targets.is_empty() && self.dice.below(8) > 0 {
            return pick(&mut self.dice, &self.targets);
        }
        let Offer { header, .. } = self.own_model();
        Target { site: site(self.dice.below(2)), header, session: 1000 }
    }

    /// A model in a name of the participant's own.
    fn own_model(&mut self) -> Offer {
        let name = match self.mode {
            Mode::Open => somebody(&mut self.dice),
            Mode::Fenced | Mode::Signed => device(INSIDER),
        };
        let number = number(&mut self.dice, ModelId(1));
        model(name, number, ModelKind::Local, self.dice.bits(), self.chunk_bytes)
    }

    fn voice(&mut self) -> Voice {
        match (self.mode, self.dice.below(6)) {
            (Mode::Open | Mode::Fenced, _) | (Mode::Signed, 0 | 1) => Voice::Plain,
            (Mode::Signed, 2) => Voice::Stranger,
            (Mode::Signed, 3) => Voice::Pretender,
            (Mode::Signed, _) if self.has_key => Voice::Insider,
            (Mode::Signed, _) => Voice::Pretender,
        }
    }

    fn act(&mut self, now: Duration) {
        match self.dice.below(14) {
            0 | 1 => self.repeat(now),
            2 => self.send_elsewhere(now),
            3 | 4 => self.damage(now),
            5 | 6 => self.forge(now),
            7 => self.upload(now),
            8 => self.swap(now),
            9 => self.spoil(now),
            10 => self.flood(now),
            11 => self.upload_junk(now),
            12 => self.ask(now),
            _ => self.babble(now),
        }
    }

    /// Says a recorded message again, once or several times.
    fn repeat(&mut self, now: Duration) {
        let Some((topic, payload)) = self.recorded() else { return };
        for _ in 0..1 + self.dice.below(5) {
            let delay = self.delay(3000);
            self.say(now + delay, &topic, payload.clone());
        }
    }

    fn recorded(&mut self) -> Option<(String, Vec<u8>)> {
        let place = self.dice.below(self.heard.len());
        self.heard.get(place).cloned()
    }

    /// Says a recorded message under another topic.
    fn send_elsewhere(&mut self, now: Duration) {
        let Some((topic, payload)) = self.recorded() else { return };
        let other = match self.recorded() {
            Some((other, _)) if self.dice.coin() => other,
            _ => {
                let mut levels: Vec<String> = topic.split('/').map(str::to_owned).collect();
                let place = 2 + self.dice.below(levels.len().saturating_sub(2));
                let words =
                    ["quarry", "region", "drone-1", "drone-2", "mallory", "0", "2", "want", "done", "m"];
                if let Some(level) = levels.get_mut(place) {
                    *level = pick(&mut self.dice, &words).to_owned();
                }
                levels.join("/")
            }
        };
        self.say(now, &other, payload);
    }

    /// Says a recorded message with changed bytes, in half of the cases with the right checksum.
    fn damage(&mut self, now: Duration) {
        let Some((topic, payload)) = self.recorded() else { return };
        let mut bytes = mutated(&mut self.dice, &[payload]);
        if self.dice.coin()
            && let Some((content, checksum)) = bytes.split_last_chunk_mut()
        {
            *checksum = crc32fast::hash(content).to_le_bytes();
        }
        self.say(now, &topic, bytes);
    }

    fn forge(&mut self, now: Duration) {
        for _ in 0..1 + self.dice.below(3) {
            let target = self.target();
            self.forge_about(now, &target);
        }
    }

    fn forge_about(&mut self, at: Duration, target: &Target) {
        let mut scratch = Scratch::default();
        let (site, topic, message) = message(&mut self.dice, target, &mut scratch);
        let voice = self.voice();
        self.voice_as(at, voice, &site, topic, &message);
    }

    fn voice_as(&mut self, at: Duration, voice: Voice, site: &SiteId, topic: Topic, message: &Message<'_>) {
        let topic = topic.to_text(site);
        let is_chunk = matches!(message, Message::Chunk(_));
        let voice = if is_chunk { Voice::Plain } else { voice };
        let payload = voiced(&mut self.dice, voice, &topic, message, &mut self.count);
        self.say(at, &topic, payload);
    }

    /// Uploads a model in its own name: all of it or a part.
    fn upload(&mut self, now: Duration) {
        let Offer { header, body } = self.own_model();
        let site = site(self.dice.below(2));
        self.send_model(now, &site, &header, &body);
    }

    /// Announces a model and sends its chunks, or some of them, in any order.
    fn send_model(&mut self, now: Duration, site: &SiteId, header: &ModelHeader, body: &[u8]) {
        let voice = if self.has_key { Voice::Insider } else { self.voice() };
        let topic = topic_of(&mut self.dice, header);
        self.voice_as(now, voice, site, topic, &Message::Header(*header));
        let share = 1 + self.dice.below(8);
        for index in 0..header.chunks().min(40) {
            let Some(range) = header.chunk_range(index) else { return };
            if self.dice.below(8) >= share {
                continue;
            }
            let payload = &body[range.start as usize..range.end as usize];
            let chunk = Chunk { device: header.device, model: header.model, index, payload };
            let delay = self.delay(3000);
            self.voice_as(
                now + delay,
                Voice::Plain,
                site,
                chunk_topic(header, index),
                &Message::Chunk(chunk),
            );
        }
    }

    /// Announces another body in the place of a genuine one, and sends it.
    fn swap(&mut self, now: Duration) {
        let target = self.target();
        let mut offer = model(
            target.header.device,
            target.header.model,
            target.header.kind,
            self.dice.bits(),
            pick(&mut self.dice, &[256, 512, 1024]),
        );
        offer.header.model =
            if self.dice.coin() { offer.header.model } else { number(&mut self.dice, target.header.model) };
        let Offer { header, body } = offer;
        self.send_model(now, &target.site, &header, &body);
    }

    /// Announces a body that is no model, with its right hash.
    fn upload_junk(&mut self, now: Duration) {
        let target = self.target();
        if target.header.body_bytes < 20_000 {
            let (header, body) = header_of_junk(&mut self.dice, &target);
            self.send_model(now, &target.site, &header, &body);
        }
    }

    /// Sends junk in the place of the chunks of a genuine model.
    fn spoil(&mut self, now: Duration) {
        let Target { site, header, .. } = self.target();
        for _ in 0..1 + self.dice.below(6) {
            let index = self.dice.below(header.chunks().min(300) as usize) as u32;
            let Some(range) = header.chunk_range(index) else { return };
            let payload = vec![7; (range.end - range.start).min(65_536) as usize];
            let chunk = Chunk { device: header.device, model: header.model, index, payload: &payload };
            let delay = self.delay(1000);
            self.voice_as(
                now + delay,
                Voice::Plain,
                &site,
                chunk_topic(&header, index),
                &Message::Chunk(chunk),
            );
        }
    }

    /// Says 10 to 40 messages about one model at once, or within two seconds.
    fn flood(&mut self, now: Duration) {
        let target = self.target();
        let span = self.delay(2000);
        let is_of_headers = self.dice.coin();
        let count = 10 + self.dice.below(31) as u32;
        for i in 0..count {
            let at = now + span * i / count;
            if is_of_headers {
                let header = header(&mut self.dice, &target);
                let (voice, topic) = (self.voice(), topic_of(&mut self.dice, &header));
                self.voice_as(at, voice, &target.site, topic, &Message::Header(header));
            } else {
                self.forge_about(at, &target);
            }
        }
    }

    /// Asks for a model again and again, as its receiver.
    fn ask(&mut self, now: Duration) {
        let Target { site, header, session } = self.target();
        let ModelHeader { device, model, .. } = header;
        let voice = self.voice();
        let by: DeviceId =
            if voice == Voice::Insider { self::device(INSIDER) } else { somebody(&mut self.dice) };
        let reply = cosurf_wire::Reply::Want;
        let topic = match header.kind {
            ModelKind::Local | ModelKind::Compressed => Topic::LocalReply { device, reply },
            ModelKind::Global | ModelKind::Manifest => Topic::GlobalReply { device: by, reply },
        };
        for i in 0..3 + self.dice.below(10) as u32 {
            let missing = cosurf_wire::Missing::of(header.chunks().min(300), |index| index < i);
            let want = cosurf_wire::Want { device, model, session, idle: true, missing };
            self.voice_as(now + Duration::from_millis(300) * i, voice, &site, topic, &Message::Want(want));
        }
    }

    /// Says what is no message of this version, or deletes what the broker retains.
    fn babble(&mut self, now: Duration) {
        let target = self.target();
        let topic = topic_of(&mut self.dice, &target.header).to_text(&target.site).as_str().to_owned();
        let mut other = vec![self.dice.below(5) as u8, 5, 9, 9, 9];
        other.extend(crc32fast::hash(&other).to_le_bytes());
        match self.dice.below(4) {
            0 => self.say(now, &topic, other),
            1 => self.say(now, "gs/v1/quarry/drone-1\n/\u{1b}[2J/state", other),
            2 => self.say(now, &topic, Vec::new()),
            _ => {
                let junk = (0..self.dice.below(300)).map(|_| self.dice.bits() as u8).collect();
                self.say(now, &topic, junk);
            }
        }
    }

    fn delay(&mut self, most_ms: usize) -> Duration {
        if self.dice.coin() { Duration::ZERO } else { Duration::from_millis(self.dice.below(most_ms) as u64) }
    }

    /// Plans to say something. A broker that knows its clients lets it through only under the participant's own name.
    fn say(&mut self, at: Duration, topic: &str, payload: Vec<u8>) {
        let mut levels: Vec<&str> = topic.split('/').collect();
        if let (Mode::Fenced, Some(name)) = (self.mode, levels.get_mut(3)) {
            *name = INSIDER;
        }
        let Ok(topic) = levels.join("/").parse() else { return };
        self.planned += 1;
        let retain = self.dice.below(4) == 0;
        self.plans.insert((at, self.planned), Outgoing { topic, payload, retain });
    }
}
