//! Keys of simulated participants, and messages that are sealed with them in any name.

use cosurf_link::{SecretKey, Trusted};
use cosurf_wire::{DeviceId, MAX_SEAL_BYTES, Message, Signature, seal};
use ed25519_dalek::{Signer as _, SigningKey};

/// The key of a participant, for messages that its own node would not send. Each name has its own key.
#[derive(Debug)]
pub struct Signer {
    /// Name of the participant.
    pub name: DeviceId,
    key: SigningKey,
}

impl Signer {
    /// The key of the participant `name`, which has at most 32 characters.
    pub fn of(name: &str) -> Self {
        Self { name: DeviceId::new(name).unwrap(), key: SigningKey::from_bytes(&secret(name)) }
    }

    /// Seals a message in the own name. `topic` is the whole topic, with the site.
    pub fn seal(&self, topic: &str, message: &Message<'_>, session: u64, count: u64) -> Vec<u8> {
        self.seal_as(self.name, topic, message, session, count)
    }

    /// Seals a message in the name of `sender`.
    pub fn seal_as(
        &self,
        sender: DeviceId,
        topic: &str,
        message: &Message<'_>,
        session: u64,
        count: u64,
    ) -> Vec<u8> {
        let mut encoded = vec![0; message.bytes_max()];
        let used = message.encode(&mut encoded).unwrap().len();
        let mut out = vec![0; used + MAX_SEAL_BYTES];
        let sign = |signed: &[u8]| {
            let signature = self.key.sign(&seal::statement(topic, signed).concat());
            Signature { r: *signature.r_bytes(), s: *signature.s_bytes() }
        };
        let used = seal::seal(&encoded[..used], (sender, session, count), sign, &mut out).unwrap().len();
        out.truncate(used);
        out
    }
}

fn secret(name: &str) -> [u8; 32] {
    let mut bytes = [0; 32];
    bytes[..name.len()].copy_from_slice(name.as_bytes());
    bytes
}

/// The secret key of a participant, as its node needs it.
pub fn key_of(name: &str) -> SecretKey {
    SecretKey::new(&secret(name))
}

/// A list with the keys of these participants.
pub fn list(names: &[&str]) -> Trusted {
    let line = |name: &&str| key_of(name).public_line(&DeviceId::new(name).unwrap());
    Trusted::parse(&names.iter().map(line).collect::<Vec<_>>().join("\n")).unwrap()
}
