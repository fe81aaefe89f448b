//! A device's side of confirmed flights: its pledge to the aggregator, and the list of the flights that count.

use std::collections::BTreeMap;
use std::time::Duration;

use cosurf_wire::{BodyHash, ConfirmedFlights, DeviceId, FlightPledge, Message, Reply, SiteId, Topic};

use crate::pacing::{Backoff, PLEDGE};
use crate::transport::Outgoing;

/// Limit on the flights of a list. No site has more devices.
const LISTED_MAX: u32 = 16_384;

/// The pledge of a device that has announced a flight. It is repeated until the aggregator's list has the flight.
#[derive(Debug)]
pub(super) struct Pledge {
    device: DeviceId,
    cameras_blake3: BodyHash,
    /// Session of the aggregator that the pledge is for, from its newest list; `None` before the first.
    session: Option<u64>,
    is_confirmed: bool,
    /// When the pledge is sent next.
    at: Duration,
    backoff: Backoff,
    /// The parts of a list that have arrived.
    parts: BTreeMap<DeviceId, BodyHash>,
}

impl Pledge {
    pub(super) fn new(device: DeviceId, cameras_blake3: BodyHash) -> Self {
        Self {
            device,
            cameras_blake3,
            session: None,
            is_confirmed: false,
            at: Duration::ZERO,
            backoff: PLEDGE,
            parts: BTreeMap::new(),
        }
    }

    /// Handles a part of a list, from an aggregator in session `session`; `None` if this device cannot sign a pledge. Returns
    /// the list if it is complete. A list of
    /// which a part is lost does not become complete; the aggregator sends it again with the next change.
    pub(super) fn on_list(
        &mut self,
        now: Duration,
        session: Option<u64>,
        part: &ConfirmedFlights<'_>,
    ) -> Option<BTreeMap<DeviceId, BodyHash>> {
        if self.session != session {
            (self.session, self.at, self.backoff) = (session, now, PLEDGE);
        }
        if part.first == 0 {
            self.parts.clear();
        }
        if part.first as usize != self.parts.len() || part.total > LISTED_MAX {
            return None;
        }
        self.parts.extend(part.records());
        if self.parts.len() < part.total as usize {
            return None;
        }
        let list = std::mem::take(&mut self.parts);
        self.is_confirmed = list.get(&self.device) == Some(&self.cameras_blake3);
        Some(list)
    }

    /// When the pledge is sent next.
    pub(super) fn next_wakeup(&self) -> Option<Duration> {
        (self.session.is_some() && !self.is_confirmed).then_some(self.at)
    }

    /// The pledge, if it is due.
    pub(super) fn next(&mut self, now: Duration, site: &SiteId) -> Option<Outgoing> {
        self.next_wakeup().filter(|at| *at <= now)?;
        let Self { device, cameras_blake3, .. } = *self;
        self.at = now + self.backoff.delay();
        let pledge = FlightPledge { device, session: self.session?, cameras_blake3 };
        let topic = Topic::GlobalReply { device, reply: Reply::Flight };
        Some(Outgoing::new(site, topic, &Message::FlightPledge(pledge), false))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_wire::CONFIRMED_FLIGHT_BYTES_MAX;

    use super::*;

    fn device(name: &str) -> DeviceId {
        DeviceId::new(name).unwrap()
    }

    fn hear(pledge: &mut Pledge, session: u64, first: u32, total: u32, names: &[&str]) -> Option<usize> {
        let encode = |name: &&str| {
            let out = &mut [0; CONFIRMED_FLIGHT_BYTES_MAX];
            ConfirmedFlights::encode_flight(device(name), BodyHash([1; 32]), out).to_vec()
        };
        let flights: Vec<u8> = names.iter().flat_map(encode).collect();
        let part = ConfirmedFlights { device: device("a"), session: 1, first, total, flights: &flights };
        pledge.on_list(Duration::ZERO, Some(session), &part).map(|list| list.len())
    }

    #[test]
    fn a_list_counts_once_all_its_parts_have_arrived_in_order() {
        let mut pledge = Pledge::new(device("a"), BodyHash([1; 32]));
        assert_eq!(pledge.next_wakeup(), None, "no aggregator is known");
        assert_eq!(hear(&mut pledge, 5, 0, 0, &[]), Some(0));
        assert_eq!(hear(&mut pledge, 5, 1, 3, &["b", "c"]), None, "the first part is missing");
        assert_eq!(hear(&mut pledge, 5, 0, 3, &["b"]), None);
        assert_eq!(hear(&mut pledge, 5, 0, 3, &["b"]), None, "the list begins again");
        assert_eq!(hear(&mut pledge, 5, 1, 3, &["c", "d"]), Some(3));
        assert_eq!(hear(&mut pledge, 5, 0, LISTED_MAX + 1, &["b"]), None);
    }

    #[test]
    fn a_pledge_is_repeated_until_it_is_listed_and_made_again_to_each_session() {
        let site = SiteId::new("site").unwrap();
        let mut pledge = Pledge::new(device("a"), BodyHash([1; 32]));
        let said = |pledge: &mut Pledge, seconds| pledge.next(Duration::from_secs(seconds), &site).is_some();
        assert!(!said(&mut pledge, 0));
        hear(&mut pledge, 5, 0, 1, &["b"]);
        assert!(said(&mut pledge, 0) && !said(&mut pledge, 1) && said(&mut pledge, 2));
        hear(&mut pledge, 5, 0, 2, &["a", "b"]);
        assert!(!said(&mut pledge, 100), "it is listed");
        hear(&mut pledge, 6, 0, 1, &["b"]);
        assert!(said(&mut pledge, 100), "to a new session");
        pledge.cameras_blake3 = BodyHash([2; 32]);
        hear(&mut pledge, 6, 0, 1, &["a"]);
        assert!(said(&mut pledge, 200), "another flight is listed");
    }
}
