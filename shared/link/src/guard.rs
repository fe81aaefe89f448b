//! Decides which messages count. With a list of keys, a message counts only if a listed key of its sender has signed it,
//! if the sender may say what it says, and if the message is not a repetition of an earlier one:
//!
//! - The start or end of a session, a flight and a model: only the device that they name may send them.
//! - A reply about a device's model: only a listed aggregator.
//! - A reply about a global model: only a listed device, and only about itself.
//! - A reply counts only if it repeats the number of this session, and if it is newer than the last one of its sender.
//! - An offer does not count if its sender has made another one since; tiles are apart, because the manifest tells which
//!   count. The same one counts again, since brokers repeat what they retain.
//! - The start or end of a session does not count if its sender has started a newer one.
//! - A flight does not count if its sender has announced one in a newer session, or if its session began more than a day
//!   before this one.
//! - The pledge of a flight counts like a reply: it repeats the number of this session of the aggregator. A list of confirmed
//!   flights repeats the number of this session of the device, and is newer than the last one. The same holds for a plan.
//!
//! Chunks are not signed. They count if the body has the hash that the header announced.

use std::collections::BTreeMap;

use cosurf_wire::{DeviceId, Message, ModelHeader, Seal, Sealed, Topic, seal};

use crate::identity::Identity;
use crate::trust::{Credentials, KeyFault, Trusted};

/// A flight of a session that is so many seconds older than this one is of another day. Sessions are numbered by the clock.
const FLIGHT_AGE_MAX_S: u64 = 24 * 3600;

/// What a participant has heard from the senders whose signatures it has checked. So there are at most as many as keys.
#[derive(Debug, Default)]
pub(crate) struct Guard {
    heard: BTreeMap<DeviceId, Heard>,
}

/// The newest messages of a sender.
#[derive(Clone, Copy, Debug, Default)]
struct Heard {
    /// Session and count of the newest offer of a model, and of a tile. An aggregator repeats both at the same time, and they
    /// may overtake each other.
    offer: (u64, u64),
    tile_offer: (u64, u64),
    flight_session: u64,
    /// The newest session that the sender has started or ended.
    session: u64,
    /// Session and count of the newest reply.
    reply: (u64, u64),
    /// Session and count of the newest list of confirmed flights.
    list: (u64, u64),
    /// Session and count of the newest plan.
    plan: (u64, u64),
}

/// Why a message does not count.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum Objection {
    /// The message is no forgery, but outdated or repeated, as happens on every network.
    #[error("it is outdated")]
    Outdated,
    /// An offer with a right signature of a session before one that was heard: somebody repeats a recorded one, or the
    /// sender's clock was ahead and its folder is new.
    #[error("it is of a session of {sender} before session {heard}, which was heard already")]
    OlderSession {
        /// The sender.
        sender: DeviceId,
        /// The newest session that was heard.
        heard: u64,
    },
    #[error("it is not signed")]
    Unsigned,
    #[error("{0} may not say it")]
    WrongSender(DeviceId),
    #[error("a list of keys `fleet` is needed for flights")]
    NoFleet,
    #[error(transparent)]
    Key(#[from] KeyFault),
}

impl Guard {
    /// Decides whether a message that arrived under `topic` counts. Returns the number of its sender's session; 0 if the
    /// message has no seal.
    pub(crate) fn admit(
        &mut self,
        own: &Identity,
        credentials: &Credentials,
        topic: &Topic,
        sealed: &Sealed<'_>,
    ) -> Result<u64, Objection> {
        let session = sealed.seal.map_or(0, |seal| seal.session);
        let Some(list) = list_for(credentials, topic, &sealed.message)? else { return Ok(session) };
        let seal = sealed.seal.ok_or(Objection::Unsigned)?;
        if said_by(topic, &sealed.message).is_some_and(|device| device != seal.sender) {
            return Err(Objection::WrongSender(seal.sender));
        }
        // A participant without a key does not tell its session.
        let own_session = if credentials.key.is_some() { own.session } else { 0 };
        let before = self.heard.get(&seal.sender).copied().unwrap_or_default();
        let heard = before.hear([own_session, own.session], &sealed.message, &seal);
        let objection = before.objection(&sealed.message, &seal);
        if heard.is_none() && objection == Objection::Outdated {
            return Err(objection);
        }
        list.check(seal.sender, seal::statement(&topic.to_text(&own.site), sealed.signed), seal.signature)?;
        self.heard.insert(seal.sender, heard.ok_or(objection)?);
        Ok(session)
    }
}

impl Heard {
    /// What was heard with this message; `None` if the message is outdated. `own_session` is the session that our seals tell,
    /// 0 if there are none, `session` the one that our births tell.
    fn hear(mut self, [own_session, session]: [u64; 2], message: &Message<'_>, seal: &Seal) -> Option<Self> {
        let is_new = match message {
            Message::Header(header) => (seal.session, seal.count) >= *self.offer_of(header),
            Message::Flight(_) => {
                seal.session >= self.flight_session
                    && seal.session.saturating_add(FLIGHT_AGE_MAX_S) >= own_session
            }
            Message::State(state) => state.session == seal.session && seal.session >= self.session,
            Message::Want(_) | Message::Done(_) | Message::Refused(_) | Message::FlightPledge(_) => {
                answered_session(message) == Some(own_session) && (seal.session, seal.count) > self.reply
            }
            Message::ConfirmedFlights(list) => {
                list.session == session && (seal.session, seal.count) > self.list
            }
            Message::Plan(plan) => plan.session == session && (seal.session, seal.count) > self.plan,
            Message::Chunk(_) => true,
        };
        match message {
            Message::Header(header) => *self.offer_of(header) = (seal.session, seal.count),
            Message::Flight(_) => self.flight_session = seal.session,
            Message::Want(_) | Message::Done(_) | Message::Refused(_) | Message::FlightPledge(_) => {
                self.reply = (seal.session, seal.count);
            }
            Message::ConfirmedFlights(_) => self.list = (seal.session, seal.count),
            Message::Plan(_) => self.plan = (seal.session, seal.count),
            Message::State(_) => self.session = seal.session,
            Message::Chunk(_) => {}
        }
        is_new.then_some(self)
    }

    /// Why a message does not count, if it does not.
    fn objection(mut self, message: &Message<'_>, seal: &Seal) -> Objection {
        match message {
            Message::Header(header) if seal.session < self.offer_of(header).0 => {
                Objection::OlderSession { sender: seal.sender, heard: self.offer_of(header).0 }
            }
            _ => Objection::Outdated,
        }
    }

    fn offer_of(&mut self, header: &ModelHeader) -> &mut (u64, u64) {
        if header.model.is_tile() { &mut self.tile_offer } else { &mut self.offer }
    }
}

/// The list with the keys that may sign a message; `None` if everybody is believed.
fn list_for<'a>(
    credentials: &'a Credentials,
    topic: &Topic,
    message: &Message<'_>,
) -> Result<Option<&'a Trusted>, Objection> {
    match (topic, message) {
        (_, Message::Chunk(_)) => Ok(None),
        (Topic::Flight { .. }, _) => match (&credentials.fleet, &credentials.trusted) {
            (Some(fleet), _) => Ok(Some(fleet)),
            (None, Some(_)) => Err(Objection::NoFleet),
            (None, None) => Ok(None),
        },
        _ => Ok(credentials.trusted.as_ref()),
    }
}

/// The only device that may say a message; `None` if every listed participant may.
fn said_by(topic: &Topic, message: &Message<'_>) -> Option<DeviceId> {
    match (topic, message) {
        (_, Message::Header(header)) => Some(header.device),
        (Topic::State { device } | Topic::Flight { device } | Topic::GlobalReply { device, .. }, _) => {
            Some(*device)
        }
        _ => None,
    }
}

/// The session whose offer a reply answers.
fn answered_session(message: &Message<'_>) -> Option<u64> {
    match message {
        Message::Want(want) => Some(want.session),
        Message::Done(done) => Some(done.session),
        Message::Refused(refused) => Some(refused.session),
        Message::FlightPledge(pledge) => Some(pledge.session),
        _ => None,
    }
}
