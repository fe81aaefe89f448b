//! Where clients come in: listening sockets, and the connections that have not said hello.

use std::collections::BTreeMap;
use std::net::IpAddr;
use std::time::Instant;

use mio::Token;

use super::super::connection::Connection;
use super::super::entrance::{descriptors_are_lacking, guests_max};
use super::super::event::BrokerEvent;
use super::super::socket::Socket;
use super::Reactor;

/// Connections accepted before others have their turn.
const ACCEPTED_AT_ONCE: usize = 64;

impl<S: Fn(BrokerEvent)> Reactor<S> {
    /// Accepts connections that wait.
    pub(super) fn accept(&mut self, now: Instant) {
        for place in 0..self.entrances.len() {
            for _ in 0..ACCEPTED_AT_ONCE {
                if !self.entrances[place].is_ready || !self.accept_one(place, now) {
                    break;
                }
            }
        }
    }

    /// Accepts a connection; false if none waits.
    fn accept_one(&mut self, place: usize, now: Instant) -> bool {
        let entrance = &mut self.entrances[place];
        let (stream, address) = match entrance.listener.accept() {
            Ok(accepted) => accepted,
            Err(error) => {
                // If nobody can be sent away, the next tick tries again.
                let goes_on = descriptors_are_lacking(&error) && self.send_a_guest_away(now);
                self.entrances[place].is_ready = goes_on;
                return goes_on;
            }
        };
        self.last_token += 1;
        let token = self.last_token;
        let socket = Socket::new(stream, entrance.tls.as_ref(), self.poll.registry(), Token(token));
        let (Ok(socket), door) = (socket, entrance.door) else { return true };
        let connection = Connection::new(socket, door, address.ip().to_canonical(), now, &self.budget);
        self.connections.insert(token, connection);
        self.turns.insert(token);
        let guests = self.connections.values().filter(|connection| !connection.is_open()).count();
        if guests > guests_max(self.clients_max) {
            self.send_a_guest_away(now);
        }
        true
    }

    /// Ends the oldest of the connections that are no clients, of the address that has the most of them. So a new one
    /// always gets in, and an address that opens many loses its own. False if there is none.
    fn send_a_guest_away(&mut self, now: Instant) -> bool {
        let guests = || self.connections.iter().filter(|(_, connection)| !connection.is_open());
        let mut counts: BTreeMap<IpAddr, usize> = BTreeMap::new();
        guests().for_each(|(_, guest)| *counts.entry(guest.address).or_default() += 1);
        let heaviest = counts.into_iter().max_by_key(|(_, count)| *count).map(|(address, _)| address);
        let oldest = guests().find(|(_, guest)| Some(guest.address) == heaviest).map(|(token, _)| *token);
        if let Some(token) = oldest {
            self.end(token, now, false);
        }
        oldest.is_some()
    }
}
