//! The second halves of QoS 2: which messages of a client are taken and not released, and which messages for it are
//! released and not completed.

use std::collections::BTreeSet;

use rumqttc::v5::mqttbytes::v5::{PubComp, PubCompReason, PubRel, PubRelReason};

/// What a packet id takes in memory, bytes.
const ID_BYTES: usize = 16;

/// The unfinished handshakes of one client.
#[derive(Debug, Default)]
pub(super) struct Handshakes {
    /// Ids of the client's messages that have been taken. Until the client releases one, the same id is a copy.
    taken: BTreeSet<u16>,
    /// Ids of messages for the client that it has got, until it says that it has forgotten them.
    released: BTreeSet<u16>,
}

impl Handshakes {
    /// Whether a message of the client is a copy of one that was taken.
    pub(super) fn is_copy(&self, pkid: u16) -> bool {
        self.taken.contains(&pkid)
    }

    /// Number of the client's messages that it has not released.
    pub(super) fn taken(&self) -> usize {
        self.taken.len()
    }

    /// Notes that a message of the client is taken.
    pub(super) fn take(&mut self, pkid: u16) {
        self.taken.insert(pkid);
    }

    /// Handles PUBREL; returns the answer.
    pub(super) fn complete(&mut self, pkid: u16) -> PubComp {
        let mut answer = PubComp::new(pkid, None);
        if !self.taken.remove(&pkid) {
            answer.reason = PubCompReason::PacketIdentifierNotFound;
        }
        answer
    }

    /// Handles PUBREC of a message that `was_sent`; returns the answer.
    pub(super) fn release(&mut self, pkid: u16, was_sent: bool) -> PubRel {
        let mut answer = PubRel::new(pkid, None);
        if was_sent {
            self.released.insert(pkid);
        } else if !self.released.contains(&pkid) {
            answer.reason = PubRelReason::PacketIdentifierNotFound;
        }
        answer
    }

    /// Handles PUBCOMP.
    pub(super) fn finish(&mut self, pkid: u16) {
        self.released.remove(&pkid);
    }

    /// Whether the id of a message for the client is still in use.
    pub(super) fn is_released(&self, pkid: u16) -> bool {
        self.released.contains(&pkid)
    }

    /// Messages for the client that it has not completed: a client that comes back is told again to release them.
    pub(super) fn released(&self) -> impl ExactSizeIterator<Item = u16> {
        self.released.iter().copied()
    }

    /// What is kept in memory, bytes.
    pub(super) fn bytes(&self) -> usize {
        (self.taken.len() + self.released.len()) * ID_BYTES
    }
}
