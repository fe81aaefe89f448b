//! Knows the truth about a conversation, and says which invariant is violated.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

use cosurf_link::{Identity, ModelKey, NodeEvent, Offer, Role};
use cosurf_scene::Camera;
use cosurf_wire::{BodyHash, DeviceId, ModelHeader, SiteId};

use super::cast::{INSIDER, device, planned};
use super::plan::Mode;

/// What holds in every conversation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Invariant {
    /// Nothing honest is lost: a sender is told that its model is stored only if it is, and no honest model is refused
    /// for good.
    Kept,
    /// Nothing dishonest is merged: what is stored was made by the device whose name it bears, byte for byte.
    Genuine,
    /// Memory is within the bound.
    Memory,
    /// Strangers get no replies, and nobody gets many.
    Replies,
    /// Honest models arrive before the deadline.
    Progress,
}

/// A violated invariant.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Violation {
    pub(crate) invariant: Invariant,
    pub(crate) what: String,
}

impl fmt::Display for Violation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?}: {}", self.invariant, self.what)
    }
}

pub(crate) type Verdict = Result<(), Violation>;

pub(crate) fn demand(holds: bool, invariant: Invariant, what: impl FnOnce() -> String) -> Verdict {
    if holds { Ok(()) } else { Err(Violation { invariant, what: what() }) }
}

/// The truth about a conversation.
pub(crate) struct Judge {
    mode: Mode,
    /// What honest participants have offered at each site, and to whom: to an aggregator or to devices.
    offered: BTreeMap<(SiteId, To, ModelKey), Offer>,
    honest: BTreeSet<DeviceId>,
    sessions: BTreeSet<(DeviceId, u64)>,
    flights: BTreeMap<DeviceId, Vec<Camera>>,
    /// Hashes of their encoded cameras.
    hashes: BTreeMap<DeviceId, BodyHash>,
    /// What each participant has on its disk.
    held: BTreeSet<(SiteId, DeviceId, ModelKey)>,
    /// Participants that must hold a model before its sender may be told so.
    receivers: BTreeMap<(SiteId, ModelKey), Vec<DeviceId>>,
    /// Senders that were told so.
    told: BTreeSet<(SiteId, ModelKey)>,
}

/// The role of those who receive a model.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum To {
    Aggregator,
    Device,
}

impl From<Role> for To {
    fn from(role: Role) -> Self {
        match role {
            Role::Aggregator => Self::Aggregator,
            Role::Device => Self::Device,
        }
    }
}

impl Judge {
    pub(crate) fn new(mode: Mode) -> Self {
        Self {
            mode,
            offered: BTreeMap::new(),
            honest: BTreeSet::new(),
            sessions: BTreeSet::new(),
            flights: BTreeMap::new(),
            hashes: BTreeMap::new(),
            held: BTreeSet::new(),
            receivers: BTreeMap::new(),
            told: BTreeSet::new(),
        }
    }

    /// Learns of the session of an honest participant.
    pub(crate) fn note_session(&mut self, device: DeviceId, session: u64) {
        self.honest.insert(device);
        self.sessions.insert((device, session));
    }

    pub(crate) fn note_flight(&mut self, device: DeviceId, cameras: &[Camera]) {
        self.flights.insert(device, cameras.to_vec());
        self.hashes.insert(device, cosurf_link::flight_hash(cameras));
    }

    /// Whether a device has announced a flight with this hash. The hostile one may announce any.
    fn is_flight(&self, of: &DeviceId, cameras_blake3: BodyHash) -> bool {
        self.hashes.get(of) == Some(&cameras_blake3) || *of == device(INSIDER)
    }

    /// Learns that an honest participant offers a model to `receivers`, which have the role `to`.
    pub(crate) fn note_offer(&mut self, site: SiteId, to: Role, offer: &Offer, receivers: &[DeviceId]) {
        let key = ModelKey::from(offer.header);
        self.offered.insert((site, to.into(), key), offer.clone());
        self.receivers.insert((site, key), receivers.to_vec());
    }

    pub(crate) fn is_held(&self, site: SiteId, by: DeviceId, key: ModelKey) -> bool {
        self.held.contains(&(site, by, key))
    }

    pub(crate) fn is_told(&self, site: SiteId, key: ModelKey) -> bool {
        self.told.contains(&(site, key))
    }

    /// The participants that must receive a model.
    pub(crate) fn receivers(&self, site: SiteId, key: ModelKey) -> Vec<DeviceId> {
        self.receivers.get(&(site, key)).cloned().unwrap_or_default()
    }

    /// The models whose senders have not been told yet that they are stored.
    pub(crate) fn untold(&self) -> impl Iterator<Item = &(SiteId, ModelKey)> {
        self.receivers.keys().filter(|offered| !self.told.contains(offered))
    }

    /// Judges an event of an honest participant.
    pub(crate) fn hear(&mut self, by: &Identity, event: &NodeEvent) -> Verdict {
        let (site, own) = (by.site, by.device);
        match event {
            NodeEvent::Store { header, body } => self.judge_model(by, header, body)?,
            NodeEvent::Receiving(header) | NodeEvent::Known(header) => {
                self.judge_source(own, header.device)?
            }
            NodeEvent::Uploaded(key, _) => {
                let lacking = self.receivers.get(&(site, *key)).into_iter().flatten();
                let lacking: Vec<_> = lacking.filter(|by| !self.is_held(site, **by, *key)).collect();
                let holds = lacking.is_empty() || self.mode == Mode::Open;
                demand(holds, Invariant::Kept, || {
                    format!("{own} is told that {key} is stored; {lacking:?} have not")
                })?;
                self.told.insert((site, *key));
            }
            NodeEvent::UploadRefused { key, by, reason } => {
                let holds = reason.is_temporary() || self.mode == Mode::Open || *by == device(INSIDER);
                demand(holds, Invariant::Kept, || {
                    format!("{own}: {key} is refused for good by {by}: {reason}")
                })?;
            }
            NodeEvent::State(state) if self.mode != Mode::Open => {
                let is_known = self.sessions.contains(&(state.device, state.session));
                demand(is_known || state.device == device(INSIDER), Invariant::Genuine, || {
                    format!("{own} believes in session {} of {}", state.session, state.device)
                })?;
            }
            NodeEvent::Flight { device: of, cameras, .. } if self.mode != Mode::Open => {
                let is_genuine = self.flights.get(of) == Some(cameras) || *of == device(INSIDER);
                demand(is_genuine, Invariant::Genuine, || format!("{own} believes a forged flight of {of}"))?;
            }
            NodeEvent::FlightPledged { device: of, session, cameras_blake3 } => {
                let is_known = self.sessions.contains(&(*of, *session)) || *of == device(INSIDER);
                demand(is_known && self.is_flight(of, *cameras_blake3), Invariant::Genuine, || {
                    format!("{own} believes a forged pledge of {of}")
                })?;
            }
            NodeEvent::ConfirmedFlights(flights) if self.mode != Mode::Open => {
                let forged =
                    flights.iter().find(|(of, cameras_blake3)| !self.is_flight(of, **cameras_blake3));
                demand(forged.is_none(), Invariant::Genuine, || {
                    format!("{own} believes that {forged:?} is confirmed")
                })?;
            }
            NodeEvent::Plan { cell, .. } if self.mode != Mode::Open => {
                demand(*cell == planned(own), Invariant::Genuine, || {
                    format!("{own} believes in the cell {cell:?}")
                })?;
            }
            NodeEvent::SameName(of) => {
                let holds = self.mode == Mode::Open || *of == device(INSIDER);
                demand(holds, Invariant::Genuine, || {
                    format!("{own} is made to believe in two participants {of}")
                })?;
            }
            _ => {}
        }
        Ok(())
    }

    /// A model that a participant is about to store.
    fn judge_model(&self, own: &Identity, header: &ModelHeader, body: &[u8]) -> Verdict {
        if self.mode == Mode::Open {
            return Ok(());
        }
        let key = ModelKey::from(header);
        if own.role == Role::Aggregator && key.device == device(INSIDER) {
            return Ok(());
        }
        let genuine = self.offered.get(&(own.site, own.role.into(), key));
        let is_genuine = genuine.is_some_and(|offer| offer.body == body);
        demand(is_genuine, Invariant::Genuine, || {
            format!("{} stores a model that {} has not made: {header:?}", own.device, key.device)
        })
    }

    /// A device whose model a participant begins to receive.
    fn judge_source(&self, own: DeviceId, source: DeviceId) -> Verdict {
        let is_known = self.honest.contains(&source) || source == device(INSIDER);
        demand(is_known || self.mode == Mode::Open, Invariant::Replies, || {
            format!("{own} answers the stranger {source}")
        })
    }

    /// Learns that a participant has a model on its disk.
    pub(crate) fn note_stored(&mut self, site: SiteId, by: DeviceId, key: ModelKey) {
        self.held.insert((site, by, key));
    }

    /// Whether a device's messages are answered.
    pub(crate) fn may_be_answered(&self, device_: &DeviceId) -> bool {
        self.mode == Mode::Open || self.honest.contains(device_) || *device_ == device(INSIDER)
    }
}
