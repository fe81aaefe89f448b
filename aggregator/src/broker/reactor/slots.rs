//! Who gives way when as many clients are connected as may be.

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::net::IpAddr;
use std::time::{Duration, Instant};

use rumqttc::v5::mqttbytes::v5::DisconnectReasonCode;

use super::super::client::Client;
use super::super::connection::Connection;
use super::super::event::BrokerEvent;
use super::Reactor;

/// Share of the places that is kept free for devices that the service knows, as a divisor.
const RESERVED_DIVISOR: usize = 4;
/// A stranger that has published and acknowledged nothing for this long gives way to another stranger.
const IDLE: Duration = Duration::from_secs(10);

impl<S: Fn(BrokerEvent)> Reactor<S> {
    /// Makes a place for a client; false if there is none.
    pub(super) fn admit(&mut self, token: usize, client: &Client, now: Instant) -> bool {
        if client.is_house() || self.router.is_connected(client) {
            return true;
        }
        let is_known = self.router.is_known(client);
        let open = self.connections.values().filter(|connection| connection.is_open()).count();
        let free = self.clients_max.saturating_sub(open.saturating_sub(self.router.houses()));
        let reserved_max = if is_known { 0 } else { self.clients_max / RESERVED_DIVISOR };
        if free > reserved_max || (free > 0 && free > reserved_max.min(self.router.absent_known())) {
            return true;
        }
        let strangers = self.strangers();
        let address = self.connections.get(&token).map(|connection| connection.address);
        let Some(victim) = victim(&strangers, address, is_known, now) else {
            self.teller.tell(now, BrokerEvent::Full { clients_max: self.clients_max });
            return false;
        };
        self.close(victim, now, DisconnectReasonCode::QuotaExceeded);
        true
    }

    /// The connected clients that the service does not know.
    fn strangers(&self) -> Vec<(usize, IpAddr, Instant)> {
        let is_stranger =
            |token: &usize| self.router.client(*token).is_some_and(|client| !self.router.is_known(client));
        let open =
            self.connections.iter().filter(|(token, connection)| connection.is_open() && is_stranger(token));
        open.map(|(token, Connection { address, useful, .. })| (*token, *address, *useful)).collect()
    }
}

/// The stranger that gives way to a new client from `address`: of an address with more strangers than that one, or, if
/// there is none, the one that has been idle for the longest time.
fn victim(
    strangers: &[(usize, IpAddr, Instant)],
    address: Option<IpAddr>,
    is_known: bool,
    now: Instant,
) -> Option<usize> {
    let mut counts: BTreeMap<IpAddr, usize> = BTreeMap::new();
    strangers.iter().for_each(|(_, address, _)| *counts.entry(*address).or_default() += 1);
    let own = address.and_then(|address| counts.get(&address)).copied().unwrap_or(0);
    let heaviest = counts.iter().max_by_key(|(_, count)| **count).filter(|(_, count)| **count > own + 1);
    let of_heaviest = |from: &IpAddr| heaviest.is_none_or(|(address, _)| address == from);
    let is_idle =
        |useful: Instant| heaviest.is_some() || is_known || now.saturating_duration_since(useful) >= IDLE;
    let candidates = strangers.iter().filter(|(_, from, useful)| of_heaviest(from) && is_idle(*useful));
    candidates
        .max_by_key(|(token, _, useful)| (Reverse(*useful), Reverse(*token)))
        .map(|(token, _, _)| *token)
}
