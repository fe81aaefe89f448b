//! Who gives way when as many clients are connected as may be.

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::net::IpAddr;
use std::time::{Duration, Instant};

use rumqttc::v5::mqttbytes::v5::DisconnectReasonCode;

use super::super::client::{Client, User};
use super::super::event::BrokerEvent;
use super::Reactor;

/// Share of the places that is kept free for devices that the service knows, as a divisor.
const RESERVED_DIVISOR: usize = 4;
/// A stranger that has published and acknowledged nothing for this long gives way to another stranger.
const IDLE: Duration = Duration::from_secs(10);
/// Limit on the connected clients of one user: its agent, and some tools. It is below that on its sessions.
const USER_CLIENTS_MAX: usize = 16;

/// Who holds a place that may be given to another.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Holder {
    /// A stranger: all strangers of an address count together.
    Address(IpAddr),
    /// A user, with all of its clients.
    User(Box<str>),
}

/// A connected client that may have to give way.
#[derive(Debug)]
struct Place {
    token: usize,
    holder: Holder,
    /// When it has last published or acknowledged a message.
    useful: Instant,
}

impl<S: Fn(BrokerEvent)> Reactor<S> {
    /// Makes a place for a client; false if there is none.
    pub(super) fn admit(&mut self, token: usize, client: &Client, now: Instant) -> bool {
        if client.is_house() || self.router.is_connected(client) {
            return true;
        }
        let places = self.places();
        let holder = self.holder(token, client);
        if let Some(victim) = holder.as_ref().and_then(|holder| own_excess(&places, holder)) {
            self.close(victim, now, DisconnectReasonCode::QuotaExceeded);
            return true;
        }
        let is_known = self.router.is_known(client);
        let open = self.connections.values().filter(|connection| connection.is_open()).count();
        let free = self.clients_max.saturating_sub(open.saturating_sub(self.router.houses()));
        let reserved_max = if is_known { 0 } else { self.clients_max / RESERVED_DIVISOR };
        if free > reserved_max || (free > 0 && free > reserved_max.min(self.router.absent_known())) {
            return true;
        }
        let Some(victim) = victim(&places, holder.as_ref(), now) else {
            self.teller.tell(now, BrokerEvent::Full { clients_max: self.clients_max });
            return false;
        };
        self.close(victim, now, DisconnectReasonCode::QuotaExceeded);
        true
    }

    /// The places that may be given to another: not those of parts of this program and of devices that the service
    /// knows by their client ids.
    fn places(&self) -> Vec<Place> {
        let open = self.connections.iter().filter(|(_, connection)| connection.is_open());
        let place = |(token, useful): (usize, Instant)| {
            let holder = self.holder(token, self.router.client(token)?)?;
            Some(Place { token, holder, useful })
        };
        open.filter_map(|(token, connection)| place((*token, connection.useful))).collect()
    }

    /// Who holds the place of a client; `None` if it is not given to another.
    fn holder(&self, token: usize, client: &Client) -> Option<Holder> {
        match client.user() {
            User::House => None,
            User::Named(name) => Some(Holder::User(name.clone())),
            User::Stranger if self.router.is_known(client) => None,
            User::Stranger => {
                self.connections.get(&token).map(|connection| Holder::Address(connection.address))
            }
        }
    }
}

/// The client of a user with too many of them that gives way to another of the same user.
fn own_excess(places: &[Place], holder: &Holder) -> Option<usize> {
    let own = || places.iter().filter(|place| place.holder == *holder);
    let is_excess = matches!(holder, Holder::User(_)) && own().count() >= USER_CLIENTS_MAX;
    longest_idle(own()).filter(|_| is_excess)
}

/// The client that gives way to a new one of `holder` (`None` for a device that the service knows by its client id): one
/// of the holder with the most places, if that one has more than the new one's; or else, among strangers, one that has
/// been idle.
fn victim(places: &[Place], holder: Option<&Holder>, now: Instant) -> Option<usize> {
    let mut counts: BTreeMap<&Holder, usize> = BTreeMap::new();
    places.iter().for_each(|place| *counts.entry(&place.holder).or_default() += 1);
    let own = holder.and_then(|holder| counts.get(holder)).copied().unwrap_or(0);
    let heaviest = counts.iter().max_by_key(|(_, count)| **count).filter(|(_, count)| **count > own + 1);
    if let Some((heaviest, _)) = heaviest {
        return longest_idle(places.iter().filter(|place| place.holder == **heaviest));
    }
    let gives_way = |place: &&Place| match (&place.holder, holder) {
        (Holder::User(_), _) => false,
        (Holder::Address(_), None) => true,
        (Holder::Address(_), Some(_)) => now.saturating_duration_since(place.useful) >= IDLE,
    };
    longest_idle(places.iter().filter(gives_way))
}

fn longest_idle<'a>(places: impl Iterator<Item = &'a Place>) -> Option<usize> {
    places.max_by_key(|place| (Reverse(place.useful), Reverse(place.token))).map(|place| place.token)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn places(holders: &[&str], now: Instant) -> Vec<Place> {
        let place = |(token, name): (usize, &&str)| Place {
            token,
            holder: user(name),
            useful: now + Duration::from_secs(token as u64),
        };
        holders.iter().enumerate().map(place).collect()
    }

    fn user(name: &str) -> Holder {
        Holder::User(name.into())
    }

    /// A full broker has a place for every user until all have the same share.
    #[test]
    fn the_user_with_the_most_places_gives_way() {
        let now = Instant::now();
        for (held, new, expected) in [
            (&["a", "b", "b", "b"][..], "c", Some(1)),
            (&["a", "b", "b", "a"], "c", Some(1)),
            (&["b", "a", "b", "a"], "c", Some(0)),
            (&["a", "b", "b"], "a", None),
            (&["a", "b"], "c", None),
        ] {
            let now_later = now + Duration::from_secs(1000);
            assert_eq!(victim(&places(held, now), Some(&user(new)), now_later), expected, "{held:?}");
        }
    }

    #[test]
    fn a_user_with_too_many_clients_loses_its_longest_idle_one() {
        let now = Instant::now();
        let mut held = vec!["other"];
        held.extend(["greedy"; USER_CLIENTS_MAX - 1]);
        assert_eq!(own_excess(&places(&held, now), &user("greedy")), None);
        held.push("greedy");
        assert_eq!(own_excess(&places(&held, now), &user("greedy")), Some(1));
        assert_eq!(own_excess(&places(&held, now), &user("other")), None);
    }
}
