//! Decides which messages pass between a serial line and the broker. It uses no port, socket or clock.
//!
//! A radio is thousands of times slower than the network, but the aggregator broadcasts at the speed of
//! the network. So a chunk of a global model passes only if the device has reported it missing. It
//! passes again only if the device reports it missing once more, after a while without any chunk. At
//! most as many chunks wait for the line as a sender keeps unacknowledged.

use std::collections::{BTreeSet, VecDeque};

use cosurf_contract::Escaped;
use cosurf_link::{Identity, Outgoing, Role, last_will};
use cosurf_wire::{ChunkStatus, DeviceId, Message, ModelId, Reply, Sealed, SiteId, State, Topic, Want};

/// Limit on chunks that wait for the line: 2 MiB at 64 KiB each, as many as a sender keeps
/// unacknowledged.
const CHUNKS_MAX: usize = 32;
/// Limit on other messages that wait for the line.
const OTHERS_MAX: usize = 64;

/// What to do with a message of the device.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Passage {
    /// The device begins a session: start its client at the broker, with this last will. There is none if the device
    /// signs its messages, because the gateway cannot sign in its name.
    Born(Identity, Option<Outgoing>),
    /// Send this message to the broker.
    Pass(Outgoing),
    /// Send this request for chunks to the broker.
    Want(Outgoing),
    /// Discard the message, for this reason.
    Refuse(String),
}

/// State of one line.
#[derive(Debug)]
pub(super) struct Relay {
    site: SiteId,
    device: Option<DeviceId>,
    birth: Option<Outgoing>,
    /// The global model that the device wants, and the chunks that it lacks.
    want: Option<Want>,
    /// Indices of chunks of the wanted model that were queued for the device and must not be queued
    /// again.
    passed: BTreeSet<u32>,
    others: VecDeque<Outgoing>,
    chunks: VecDeque<(ModelId, u32, Outgoing)>,
}

impl Relay {
    pub(super) fn new(site: SiteId) -> Self {
        Self {
            site,
            device: None,
            birth: None,
            want: None,
            passed: BTreeSet::new(),
            others: VecDeque::new(),
            chunks: VecDeque::new(),
        }
    }

    /// The newest birth notice of the device.
    pub(super) fn birth(&self) -> Option<Outgoing> {
        self.birth.clone()
    }

    /// Handles a message from the device. The device may publish only under its own name.
    pub(super) fn hear_device(&mut self, topic: &str, payload: Vec<u8>) -> Passage {
        let refuse = |reason: &str| Passage::Refuse(format!("{}: {reason}", Escaped(topic)));
        let (site, parsed) = match Topic::parse(topic) {
            Ok(parsed) => parsed,
            Err(error) => return refuse(&error.to_string()),
        };
        let (device, is_retained) = match parsed {
            Topic::State { device } | Topic::Flight { device } | Topic::LocalHeader { device, .. } => {
                (device, true)
            }
            Topic::LocalChunk { device, .. } | Topic::GlobalReply { device, .. } => (device, false),
            _ => return refuse("devices do not publish on this topic"),
        };
        if site != self.site {
            return refuse("belongs to another site");
        }
        let message = Outgoing { topic: parsed.to_text(&site), payload, retain: is_retained };
        let mut is_want = false;
        if let Ok(Sealed { message: said, seal, .. }) = Sealed::decode(&message.payload) {
            match (parsed, said) {
                (Topic::State { .. }, Message::State(State { session, alive: true, .. })) => {
                    let identity = Identity { site, device, session, role: Role::Device };
                    let will = seal.is_none().then(|| last_will(&identity, None));
                    *self = Self { device: Some(device), birth: Some(message), ..Self::new(site) };
                    return Passage::Born(identity, will);
                }
                (Topic::GlobalReply { reply: Reply::Want, .. }, Message::Want(want)) => {
                    is_want = true;
                    self.note(want);
                }
                _ => {}
            }
        }
        match self.device {
            Some(known) if known == device && is_want => Passage::Want(message),
            Some(known) if known == device => Passage::Pass(message),
            Some(_) => refuse("the line belongs to another device"),
            None => refuse("no device has announced its birth on this line"),
        }
    }

    /// Queues a message from the broker for the device. Discards the device's own flight, chunks that the device
    /// does not need now, other messages that are queued already, and everything beyond the limits.
    pub(super) fn hear_broker(&mut self, topic: &str, payload: Vec<u8>) {
        let Ok((site, parsed)) = Topic::parse(topic) else { return };
        let message = Outgoing { topic: parsed.to_text(&site), payload, retain: false };
        match parsed {
            // The device has published this flight itself.
            Topic::Flight { device } if self.device == Some(device) => {}
            Topic::GlobalChunk { model, index, .. } | Topic::TileChunk { model, index, .. } => {
                let is_wanted = self.want.as_ref().is_some_and(|want| {
                    want.model == model && want.missing.status_of(index) == ChunkStatus::Missing
                });
                if is_wanted && self.chunks.len() < CHUNKS_MAX && self.passed.insert(index) {
                    self.chunks.push_back((model, index, message));
                }
            }
            _ if self.others.len() < OTHERS_MAX && !self.others.contains(&message) => {
                self.others.push_back(message);
            }
            _ => {}
        }
    }

    /// The next message for the device.
    pub(super) fn next_down(&self) -> Option<&Outgoing> {
        self.others.front().or_else(|| self.chunks.front().map(|(_, _, message)| message))
    }

    /// Removes the next message, once the line has accepted it.
    pub(super) fn passed_down(&mut self) {
        if self.others.pop_front().is_none() {
            self.chunks.pop_front();
        }
    }

    /// Notes the chunks that the device lacks. If no chunk has arrived for a while (`want.idle`),
    /// chunks that were sent before may pass again.
    fn note(&mut self, want: Want) {
        let is_other = self.want.as_ref().is_none_or(|before| before.model != want.model);
        if is_other {
            self.chunks.clear();
        }
        if is_other || want.idle {
            self.passed = self.chunks.iter().map(|(_, index, _)| *index).collect();
        }
        self.want = Some(want);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_wire::{MAX_MESSAGE_BYTES, Missing, TileId};

    use super::*;

    fn site() -> SiteId {
        SiteId::new("site").unwrap()
    }

    fn device(name: &str) -> DeviceId {
        DeviceId::new(name).unwrap()
    }

    fn bytes(message: &Message<'_>) -> Vec<u8> {
        message.encode(&mut vec![0; MAX_MESSAGE_BYTES]).unwrap().to_vec()
    }

    fn say(relay: &mut Relay, topic: Topic, message: &Message<'_>) -> Passage {
        relay.hear_device(&topic.to_text(&site()), bytes(message))
    }

    fn born(relay: &mut Relay, name: &str) -> Passage {
        let state = State { device: device(name), session: 5, alive: true };
        say(relay, Topic::State { device: device(name) }, &Message::State(state))
    }

    fn want(relay: &mut Relay, idle: bool, has: &[u32]) {
        let missing = Missing::of(100, |index| has.contains(&index));
        let want = Want { device: device("ground"), model: ModelId(1), session: 5, idle, missing };
        let topic = Topic::GlobalReply { device: device("drone"), reply: Reply::Want };
        assert!(matches!(say(relay, topic, &Message::Want(want)), Passage::Want(_)));
    }

    fn chunk(relay: &mut Relay, index: u32) {
        let topic = Topic::GlobalChunk { tile: TileId::WHOLE, model: ModelId(1), index };
        relay.hear_broker(&topic.to_text(&site()), vec![index as u8]);
    }

    fn all_down(relay: &mut Relay) -> Vec<u8> {
        let mut first_bytes = Vec::new();
        while let Some(message) = relay.next_down() {
            first_bytes.push(message.payload[0]);
            relay.passed_down();
        }
        first_bytes
    }

    #[test]
    fn a_device_publishes_only_after_its_birth_and_under_its_own_name() {
        let mut relay = Relay::new(site());
        let header = Topic::LocalHeader { device: device("drone"), model: ModelId(1) }.to_text(&site());
        assert!(matches!(relay.hear_device(&header, vec![1]), Passage::Refuse(_)), "before its birth");
        let Passage::Born(identity, will) = born(&mut relay, "drone") else { panic!("a birth") };
        assert_eq!((identity.device, identity.session), (device("drone"), 5));
        assert_eq!(will, Some(last_will(&identity, None)));
        let Passage::Pass(message) = relay.hear_device(&header, vec![1]) else { panic!("passes") };
        assert!(message.retain, "headers are retained");
        let flight = Topic::Flight { device: device("drone") }.to_text(&site());
        let Passage::Pass(message) = relay.hear_device(&flight, vec![1]) else { panic!("passes") };
        assert!(message.retain, "flights are retained");
        for topic in [
            Topic::LocalHeader { device: device("other"), model: ModelId(1) },
            Topic::GlobalHeader { tile: TileId::WHOLE },
            Topic::LocalReply { device: device("drone"), reply: Reply::Done },
        ] {
            let passage = relay.hear_device(&topic.to_text(&site()), vec![1]);
            assert!(matches!(passage, Passage::Refuse(_)), "{topic}");
        }
        let elsewhere = SiteId::new("elsewhere").unwrap();
        let topic = Topic::State { device: device("drone") }.to_text(&elsewhere);
        assert!(matches!(relay.hear_device(&topic, vec![1]), Passage::Refuse(_)));
    }

    #[test]
    fn flights_of_other_devices_pass_but_not_its_own() {
        let mut relay = Relay::new(site());
        born(&mut relay, "drone");
        for (i, name) in ["drone", "other"].into_iter().enumerate() {
            let topic = Topic::Flight { device: device(name) };
            relay.hear_broker(&topic.to_text(&site()), vec![i as u8]);
        }
        assert_eq!(all_down(&mut relay), [1]);
    }

    #[test]
    fn only_wanted_chunks_pass_and_again_only_if_lost() {
        let mut relay = Relay::new(site());
        born(&mut relay, "drone");
        chunk(&mut relay, 3);
        assert_eq!(all_down(&mut relay), [0; 0], "no chunk is wanted yet");
        want(&mut relay, false, &[0, 1]);
        [0, 2, 3, 3].iter().for_each(|index| chunk(&mut relay, *index));
        assert_eq!(all_down(&mut relay), [2, 3]);
        chunk(&mut relay, 2);
        assert_eq!(all_down(&mut relay), [0; 0], "it has passed already");
        want(&mut relay, true, &[0, 1, 3]);
        [2, 3].iter().for_each(|index| chunk(&mut relay, *index));
        assert_eq!(all_down(&mut relay), [2], "a lost chunk passes again");
    }

    #[test]
    fn queues_are_bounded_and_other_messages_go_before_chunks() {
        let mut relay = Relay::new(site());
        born(&mut relay, "drone");
        want(&mut relay, false, &[]);
        (0..100).for_each(|index| chunk(&mut relay, index));
        for i in 0..200u32 {
            let topic = Topic::LocalReply { device: device("drone"), reply: Reply::Done };
            relay.hear_broker(&topic.to_text(&site()), vec![200, i as u8]);
        }
        let down = all_down(&mut relay);
        assert_eq!(down.len(), CHUNKS_MAX + OTHERS_MAX);
        assert!(down[..OTHERS_MAX].iter().all(|byte| *byte == 200), "other messages go first");
    }
}
