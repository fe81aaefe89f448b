//! The sessions of other devices, from their birth and death notices.

use std::collections::BTreeMap;

use cosurf_wire::{DeviceId, State};

/// Maximum number of devices whose sessions are remembered.
const DEVICES_MAX: usize = 1024;
/// This many births of an older session after a newer one show that two participants use the same name. A
/// broker may repeat an outdated birth once or twice.
const RETURNS_MAX: u32 = 3;

/// The sessions of each device.
#[derive(Debug, Default)]
pub(super) struct Births(BTreeMap<DeviceId, Sessions>);

#[derive(Clone, Copy, Debug, Default)]
struct Sessions {
    newest: u64,
    /// Number of births of an older session after that of the newest.
    returns: u32,
}

/// What a birth or death notice means.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Notice {
    /// The death of an older session than the newest: the broker published it late.
    Outdated,
    /// The notice is valid.
    Valid,
    /// The notice is valid, and shows that two participants use the same name.
    SameName,
}

impl Births {
    /// Records a birth or death notice.
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
