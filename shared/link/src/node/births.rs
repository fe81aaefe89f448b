//! The sessions of other devices, as their birth and death notices ([`State`]) announce them.

use std::collections::BTreeMap;

use cosurf_wire::{DeviceId, State};

/// Maximum number of devices whose sessions are remembered. All notices of further devices count as valid.
const DEVICES_MAX: usize = 1024;
/// If births of an older session arrive this many times after the birth of a newer one, two participants use
/// the same name. Fewer are no proof, since a broker may repeat an outdated birth once or twice.
const RETURNS_MAX: u32 = 3;

/// The sessions of each device.
#[derive(Debug, Default)]
pub(super) struct Births(BTreeMap<DeviceId, Sessions>);

#[derive(Clone, Copy, Debug, Default)]
struct Sessions {
    newest: u64,
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
}

impl Births {
    /// Records a birth or death notice, and returns what it means.
    pub(super) fn record(&mut self, state: &State) -> Notice {
        let known = self.0.get(&state.device).copied();
        let is_past = known.is_some_and(|known| known.newest > state.session);
        if !state.alive && is_past {
            return Notice::Outdated;
        }
        if self.0.len() >= DEVICES_MAX && known.is_none() {
            return Notice::Valid;
        }
        let Sessions { newest, returns } = known.unwrap_or_default();
        let returns = returns + u32::from(is_past);
        self.0.insert(state.device, Sessions { newest: newest.max(state.session), returns });
        if is_past && returns == RETURNS_MAX { Notice::SameName } else { Notice::Valid }
    }
}
