//! Seals the messages that a participant sends.

use cosurf_wire::{MAX_SEAL_BYTES, Topic, VERSION, seal};

use crate::identity::Identity;
use crate::transport::Outgoing;
use crate::trust::SecretKey;

/// The messages that a participant has sealed in its session.
#[derive(Debug, Default)]
pub(crate) struct Sealer {
    count: u64,
}

impl Sealer {
    /// Seals a message with the participant's key, unless it is a chunk, deletes a retained message, or is of
    /// another version.
    pub(crate) fn seal(
        &mut self,
        identity: &Identity,
        key: Option<&SecretKey>,
        message: Outgoing,
    ) -> Outgoing {
        let is_ours = message.payload.first() == Some(&VERSION);
        let Some(key) = key.filter(|_| is_ours && !is_chunk(&message)) else {
            return message;
        };
        self.count += 1;
        sealed(identity, key, self.count, message)
    }
}

/// The notice that the participant's session has ended, sealed if there is a key. The broker publishes it when the
/// connection breaks.
pub fn last_will(identity: &Identity, key: Option<&SecretKey>) -> Outgoing {
    let death = identity.state_message(false);
    match key {
        Some(key) => sealed(identity, key, u64::MAX, death),
        None => death,
    }
}

fn sealed(identity: &Identity, key: &SecretKey, count: u64, message: Outgoing) -> Outgoing {
    let mut payload = vec![0; message.payload.len() + MAX_SEAL_BYTES];
    let sign = |signed: &[u8]| key.sign(seal::statement(&message.topic, signed));
    // Cannot fail: a test of the wire crate checks the largest seal.
    let used = seal::seal(&message.payload, (identity.device, identity.session, count), sign, &mut payload);
    let used = used.expect("a seal fits MAX_SEAL_BYTES").len();
    payload.truncate(used);
    Outgoing { payload, ..message }
}

fn is_chunk(message: &Outgoing) -> bool {
    let topic = Topic::parse(&message.topic).map(|(_, topic)| topic);
    matches!(topic, Ok(Topic::LocalChunk { .. } | Topic::GlobalChunk { .. } | Topic::TileChunk { .. }))
}
