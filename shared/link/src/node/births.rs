//! The sessions of other devices, as their birth and death notices ([`State`]) announce them.

use std::collections::BTreeMap;

use cosurf_wire::{DeviceId, State};

use crate::identity::Identity;

/// If births of an older session arrive this many times after the birth of a newer one, two participants use
/// the same name. Fewer are no proof, since a broker may repeat an outdated birth once or twice.
const RETURNS_MAX: u32 = 3;

/// The sessions of each device.
#[derive(Debug, Default)]
pub(super) struct Births {
    sessions: BTreeMap<DeviceId, Sessions>,
    is_full_told: bool,
    /// The newest session of another participant under this one's name; 0 if there is none.
    rival: u64,
}

#[derive(Clone, Copy, Debug, Default)]
struct Sessions {
    newest: u64,
    /// The session that the seal of the newest notice tells; 0 if it has none.
    sealed: u64,
    /// Number of births that arrived after the birth of a newer session.
    returns: u32,
}

/// What a birth or death notice means.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Notice {
    /// The notice is the death of a session that is not the newest. The broker published it late.
    Outdated,
    /// The notice is valid.
    Valid,
    /// The notice is valid, and it shows that two participants use the same name.
    SameName,
    /// The notice is valid. It is the first of a device beyond the limit, whose sessions are not remembered.
    TooManyDevices,
}

impl Births {
    /// Records a birth or death notice, whose seal tells the session `sealed`, and returns what it means. Remembers the
    /// sessions of at most `devices_max` devices; all notices of further devices count as valid.
    pub(super) fn record(&mut self, state: &State, sealed: u64, devices_max: usize) -> Notice {
        let known = self.sessions.get(&state.device).copied();
        let is_past = known.is_some_and(|known| known.newest > state.session);
        if !state.alive && is_past {
            return Notice::Outdated;
        }
        if self.sessions.len() >= devices_max && known.is_none() {
            let is_first = !std::mem::replace(&mut self.is_full_told, true);
            return if is_first { Notice::TooManyDevices } else { Notice::Valid };
        }
        let Sessions { newest, sealed: before, returns } = known.unwrap_or_default();
        let returns = returns + u32::from(is_past);
        let sealed = if is_past { before } else { sealed };
        self.sessions.insert(state.device, Sessions { newest: newest.max(state.session), sealed, returns });
        if is_past && returns == RETURNS_MAX { Notice::SameName } else { Notice::Valid }
    }

    /// Whether a birth is the first of a later session under this participant's own name, which another one must have begun. If
    /// the broker lets both stay connected, there are no more births.
    pub(super) fn is_new_rival(&mut self, own: &Identity, state: &State) -> bool {
        let is_later = state.session > self.rival.max(own.session);
        let is_rival = state.device == own.device && state.alive && is_later;
        if is_rival {
            self.rival = state.session;
        }
        is_rival
    }

    /// The session by which a device knows replies to its offers; `None` if none of its notices has arrived.
    pub(super) fn replied_session(&self, device: DeviceId) -> Option<u64> {
        self.sessions.get(&device).map(|sessions| sessions.sealed)
    }
}
