//! An aggregator's side of confirmed flights: it sends the list of the flights that count to every device that is there.

use std::collections::BTreeMap;
use std::time::Duration;

use cosurf_wire::{
    BodyHash, CONFIRMED_FLIGHT_BYTES_MAX, CONFIRMED_FLIGHTS_MAX, ConfirmedFlights, DeviceId, Message, Reply,
    SiteId, State, Topic,
};

use crate::pacing::CONFIRM_PAUSE;
use crate::transport::Outgoing;

/// The list, and the devices that get it.
#[derive(Debug, Default)]
pub(super) struct Confirming {
    flights: Vec<(DeviceId, BodyHash)>,
    receivers: BTreeMap<DeviceId, Receiver>,
}

#[derive(Debug)]
struct Receiver {
    /// The device's session.
    session: u64,
    /// Index of the first flight of the part that is sent next; `None` if the device has the list.
    next: Option<usize>,
    /// When it is sent.
    at: Duration,
}

impl Confirming {
    /// Sets the list. If it has changed, all devices get it.
    pub(super) fn set(&mut self, flights: Vec<(DeviceId, BodyHash)>) {
        if self.flights != flights {
            self.flights = flights;
            self.receivers.values_mut().for_each(|receiver| receiver.next = Some(0));
        }
    }

    /// A device has started or ended a session. At its start it gets the list, even an empty one, which tells it our own
    /// session. At most `devices_max` devices do.
    pub(super) fn on_state(&mut self, now: Duration, state: &State, devices_max: usize) {
        let State { device, session, alive } = *state;
        let known = self.receivers.get(&device);
        if alive && (known.is_some() || self.receivers.len() < devices_max) {
            let at = known.map_or(now, |known| known.at);
            self.receivers.insert(device, Receiver { session, next: Some(0), at });
        } else if !alive && known.is_some_and(|known| known.session == session) {
            self.receivers.remove(&device);
        }
    }

    /// A device has pledged its flight. It gets the list again, in case that it has missed a part.
    pub(super) fn on_pledge(&mut self, device: &DeviceId) {
        if let Some(receiver) = self.receivers.get_mut(device) {
            receiver.next.get_or_insert(0);
        }
    }

    /// When the next part is due.
    pub(super) fn next_wakeup(&self) -> Option<Duration> {
        let due = self.receivers.values().filter(|receiver| receiver.next.is_some());
        due.map(|receiver| receiver.at).min()
    }

    /// The next part that is due.
    pub(super) fn next(&mut self, now: Duration, site: &SiteId) -> Option<Outgoing> {
        let is_due = |receiver: &Receiver| receiver.next.is_some() && receiver.at <= now;
        let (device, receiver) = self.receivers.iter_mut().find(|(_, receiver)| is_due(receiver))?;
        let (device, first, total) = (*device, receiver.next?, self.flights.len());
        let end = total.min(first + CONFIRMED_FLIGHTS_MAX);
        let mut flights = Vec::new();
        for (device, cameras_blake3) in &self.flights[first..end] {
            let out = &mut [0; CONFIRMED_FLIGHT_BYTES_MAX];
            flights.extend_from_slice(ConfirmedFlights::encode_flight(*device, *cameras_blake3, out));
        }
        receiver.next = (end < total).then_some(end);
        if receiver.next.is_none() {
            receiver.at = now + CONFIRM_PAUSE;
        }
        let (session, first, total) = (receiver.session, first as u32, total as u32);
        let part = ConfirmedFlights { device, session, first, total, flights: &flights };
        let topic = Topic::LocalReply { device, reply: Reply::Flight };
        Some(Outgoing::new(site, topic, &Message::ConfirmedFlights(part), false))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn state(name: &str, session: u64, alive: bool) -> State {
        State { device: DeviceId::new(name).unwrap(), session, alive }
    }

    /// The parts that are due: receiver, its session, first index, number of flights.
    fn parts(confirming: &mut Confirming, now_s: u64) -> Vec<(String, u64, u32, usize)> {
        let site = SiteId::new("site").unwrap();
        let now = Duration::from_secs(now_s);
        let messages = std::iter::from_fn(|| confirming.next(now, &site));
        let part = |message: Outgoing| match Message::decode(&message.payload).unwrap() {
            Message::ConfirmedFlights(part) => {
                (part.device.to_string(), part.session, part.first, part.records().count())
            }
            other => panic!("{other:?}"),
        };
        messages.map(part).collect()
    }

    #[test]
    fn each_device_that_is_there_gets_each_new_list_in_parts() {
        let mut confirming = Confirming::default();
        for (name, alive) in [("a", true), ("b", true), ("c", true), ("b", false), ("e", true)] {
            confirming.on_state(Duration::ZERO, &state(name, 7, alive), 3);
        }
        confirming.on_state(Duration::ZERO, &state("a", 6, false), 3);
        let lists = |names: &[&str], first, count| -> Vec<_> {
            names.iter().map(|name| (name.to_string(), 7, first, count)).collect()
        };
        assert_eq!(parts(&mut confirming, 0), lists(&["a", "c", "e"], 0, 0), "empty at first");
        let flights = |count: usize| -> Vec<_> {
            let device = |i| DeviceId::new(&format!("d{i}")).unwrap();
            (0..count).map(|i| (device(i), BodyHash([3; 32]))).collect()
        };
        confirming.set(flights(CONFIRMED_FLIGHTS_MAX + 5));
        assert_eq!(parts(&mut confirming, 0), [], "not so soon");
        let each = ["a", "c", "e"].map(|name| {
            [
                (name.to_owned(), 7, 0, CONFIRMED_FLIGHTS_MAX),
                (name.to_owned(), 7, CONFIRMED_FLIGHTS_MAX as u32, 5),
            ]
        });
        assert_eq!(parts(&mut confirming, 10), each.concat());
        confirming.set(flights(CONFIRMED_FLIGHTS_MAX + 5));
        assert_eq!((parts(&mut confirming, 20), confirming.next_wakeup()), (vec![], None), "no change");
        confirming.set(flights(1));
        confirming.on_pledge(&DeviceId::new("c").unwrap());
        assert_eq!(parts(&mut confirming, 20), lists(&["a", "c", "e"], 0, 1));
        confirming.on_pledge(&DeviceId::new("c").unwrap());
        assert_eq!(parts(&mut confirming, 30), lists(&["c"], 0, 1), "again after a pledge");
    }
}
