//! The pledges of flights that devices have made to this session of the service. Devices leave ground to each other only as
//! far as the service confirms these pledges.

use std::collections::BTreeMap;

use cosurf_wire::{BodyHash, DeviceId};

/// The newest pledge of each device. Pledges are not kept on the disk: after a restart, connected devices pledge again.
#[derive(Debug)]
pub(super) struct Flights {
    /// Number of the service's own session.
    session: u64,
    /// The session of each device, and the hash of its cameras.
    pledged: BTreeMap<DeviceId, (u64, BodyHash)>,
}

impl Flights {
    pub(super) fn new(session: u64) -> Self {
        Self { session, pledged: BTreeMap::new() }
    }

    /// Notes the pledge of a device in its session `session`. Returns whether the list has changed. Pledges of sessions up to
    /// `withdrawn` do not count, nor those of a session before the newest.
    pub(super) fn pledge(
        &mut self,
        device: DeviceId,
        session: u64,
        cameras_blake3: BodyHash,
        withdrawn: Option<u64>,
    ) -> bool {
        let known = self.pledged.get(&device);
        if Some(session) <= withdrawn || known.is_some_and(|(newest, _)| session < *newest) {
            return false;
        }
        let is_new = known.is_none_or(|(_, known)| *known != cameras_blake3);
        self.pledged.insert(device, (session, cameras_blake3));
        is_new
    }

    /// Removes the pledge of a device. Returns the session up to which its pledges no longer count: that of the pledge, and
    /// that of a device which has started before the service and has not pledged yet.
    pub(super) fn withdraw(&mut self, device: &DeviceId) -> u64 {
        self.pledged.remove(device).map_or(self.session, |(session, _)| session.max(self.session))
    }

    /// Devices, and the hashes of their cameras.
    pub(super) fn list(&self) -> Vec<(DeviceId, BodyHash)> {
        self.pledged.iter().map(|(device, (_, cameras_blake3))| (*device, *cameras_blake3)).collect()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn the_newest_pledge_of_a_device_counts_until_it_is_withdrawn() {
        let device = DeviceId::new("drone-1").unwrap();
        let hash = |byte| BodyHash([byte; 32]);
        let mut flights = Flights::new(100);
        assert!(flights.pledge(device, 50, hash(1), None));
        assert!(!flights.pledge(device, 51, hash(1), None), "the same flight");
        assert!(!flights.pledge(device, 50, hash(2), None), "a session before");
        assert!(flights.pledge(device, 52, hash(3), None));
        assert_eq!(flights.list(), [(device, hash(3))]);
        let until = flights.withdraw(&device);
        assert_eq!((until, flights.list()), (100, vec![]));
        assert!(!flights.pledge(device, 100, hash(3), Some(until)));
        assert!(flights.pledge(device, 120, hash(3), Some(until)), "a later flight");
        assert_eq!(flights.withdraw(&device), 120);
    }
}
