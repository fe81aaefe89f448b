//! What the attackers know: where the broker is, who flies, and what has been said.

use std::collections::VecDeque;
use std::fs;
use std::io;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

use cosurf_tests::dice::Dice;
use cosurf_tests::mqtt::Hello;
use cosurf_wire::{DeviceId, MAX_SEAL_BYTES, Message, ModelHeader, Sealed, Signature, SiteId, Topic, seal};
use ed25519_dalek::{Signer, SigningKey};

use crate::line::Line;

/// The site of all missions.
pub(crate) const SITE: &str = "site";
/// The aggregator's name.
pub(crate) const GROUND: &str = "ground";
/// A drone with keys that sends what an honest one does not.
pub(crate) const TRAITOR: &str = "traitor";
/// Others, which sign what no program of ours would sign.
pub(crate) const SIGNERS: [&str; 5] = ["signer", "hoarder-1", "hoarder-2", "hoarder-3", "hoarder-4"];
/// Messages that are remembered.
const HEARD_MAX: usize = 2000;

/// The two honest drones of a mission.
pub(crate) fn drones(mission: usize) -> [String; 2] {
    [1, 2].map(|drone| format!("drone-{mission}-{drone}"))
}

/// What the attackers know.
pub(crate) struct Field {
    pub(crate) address: SocketAddr,
    /// The folder that `pki` has made.
    pub(crate) keys: PathBuf,
    /// User and password of the attackers, if the broker asks for them.
    pub(crate) login: Option<(&'static str, &'static str)>,
    mission: AtomicUsize,
    is_over: AtomicBool,
    /// Genuine messages, the newest last.
    heard: Mutex<VecDeque<(String, Vec<u8>)>>,
}

impl Field {
    pub(crate) fn new(address: SocketAddr, keys: &Path, login: Option<(&'static str, &'static str)>) -> Self {
        Self {
            address,
            keys: keys.to_owned(),
            login,
            mission: AtomicUsize::new(0),
            is_over: AtomicBool::new(false),
            heard: Mutex::default(),
        }
    }

    pub(crate) fn begin_mission(&self, mission: usize) {
        self.mission.store(mission, Ordering::Relaxed);
    }

    pub(crate) fn mission(&self) -> usize {
        self.mission.load(Ordering::Relaxed)
    }

    pub(crate) fn end(&self) {
        self.is_over.store(true, Ordering::Relaxed);
    }

    pub(crate) fn is_over(&self) -> bool {
        self.is_over.load(Ordering::Relaxed)
    }

    /// One of the drones that fly now.
    pub(crate) fn victim(&self, dice: &mut Dice) -> DeviceId {
        device(&drones(self.mission())[dice.below(2)])
    }

    /// Connects an attacker.
    pub(crate) fn join(&self, id: &str) -> io::Result<Line> {
        Line::open(self.address, &Hello { id, login: self.login, ..Hello::default() })
    }

    /// Remembers a message if a participant has signed it, or if it is a chunk.
    pub(crate) fn hear(&self, topic: String, payload: Vec<u8>) {
        let is_genuine = match Sealed::decode(&payload) {
            Ok(sealed) => {
                let is_honest =
                    |sender: DeviceId| sender.as_str() == GROUND || sender.as_str().starts_with("drone");
                sealed.seal.is_some_and(|seal| is_honest(seal.sender))
                    || matches!(sealed.message, Message::Chunk(_))
            }
            Err(_) => false,
        };
        if is_genuine {
            let mut heard = self.heard.lock().unwrap_or_else(PoisonError::into_inner);
            if heard.len() == HEARD_MAX {
                heard.pop_front();
            }
            heard.push_back((topic, payload));
        }
    }

    /// A message that was heard; `None` before the first one.
    pub(crate) fn echo(&self, dice: &mut Dice) -> Option<(String, Vec<u8>)> {
        let heard = self.heard.lock().unwrap_or_else(PoisonError::into_inner);
        (!heard.is_empty()).then(|| heard[dice.below(heard.len())].clone())
    }

    /// The newest headers that were heard, with the sessions of their senders: first the newest.
    pub(crate) fn headers(&self) -> Vec<(Topic, ModelHeader, u64)> {
        let heard = self.heard.lock().unwrap_or_else(PoisonError::into_inner);
        let header = |(topic, payload): &(String, Vec<u8>)| {
            let sealed = Sealed::decode(payload).ok()?;
            let Message::Header(header) = sealed.message else { return None };
            Some((Topic::parse(topic).ok()?.1, header, sealed.seal?.session))
        };
        heard.iter().rev().filter_map(header).take(4).collect()
    }

    /// The secret key that `pki` has made for a participant.
    pub(crate) fn key_of(&self, name: &str) -> SigningKey {
        let text = fs::read_to_string(self.keys.join(name).join("sign.key")).unwrap();
        let digit = |place: usize| u8::from_str_radix(&text[2 * place..2 * place + 2], 16).unwrap();
        SigningKey::from_bytes(&std::array::from_fn(digit))
    }
}

/// The name of a device.
pub(crate) fn device(name: &str) -> DeviceId {
    DeviceId::new(name).unwrap()
}

/// The text of a topic on the site.
pub(crate) fn text(topic: Topic) -> String {
    topic.to_text(&SiteId::new(SITE).unwrap()).as_str().to_owned()
}

/// The bytes of a message without a seal.
pub(crate) fn encode(message: &Message<'_>) -> Vec<u8> {
    let mut bytes = vec![0; message.bytes_max()];
    let used = message.encode(&mut bytes).unwrap().len();
    bytes.truncate(used);
    bytes
}

/// The bytes of a message that `sender` seems to have signed, with any key.
pub(crate) fn sealed(
    key: &SigningKey,
    sender: DeviceId,
    at: (u64, u64),
    topic: Topic,
    message: &Message<'_>,
) -> Vec<u8> {
    let (encoded, topic) = (encode(message), text(topic));
    let sign = |signed: &[u8]| {
        let signature = key.sign(&seal::statement(&topic, signed).concat());
        Signature { r: *signature.r_bytes(), s: *signature.s_bytes() }
    };
    let mut out = vec![0; encoded.len() + MAX_SEAL_BYTES];
    seal::seal(&encoded, (sender, at.0, at.1), sign, &mut out).unwrap().to_vec()
}
