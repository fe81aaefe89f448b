//! In which order connections have their packets handled, and for how long, so that packets that take long to handle hold
//! up those who send them, and nobody else.

use std::time::{Duration, Instant};

use super::super::event::BrokerEvent;
use super::Reactor;

/// Longest time that one connection's packets are handled before others have their turn.
const TURN: Duration = Duration::from_millis(2);
/// Longest time that strangers' packets are handled before known clients have their turn again.
const STRANGERS_TURN: Duration = Duration::from_millis(20);

impl<S: Fn(BrokerEvent)> Reactor<S> {
    /// Lets connections that have packets handle some of them: known clients and those that say hello first, then
    /// strangers in turn while there is time.
    pub(super) fn take_turns(&mut self, now: Instant) {
        let turns = std::mem::take(&mut self.turns);
        let (strangers, others): (Vec<usize>, Vec<usize>) =
            turns.into_iter().partition(|token| self.is_stranger(*token));
        others.into_iter().for_each(|token| self.take_turn(token, now));
        let until = Instant::now() + STRANGERS_TURN;
        let (had, next): (Vec<usize>, Vec<usize>) =
            strangers.into_iter().partition(|token| *token <= self.last_turn);
        for token in next.into_iter().chain(had) {
            if Instant::now() >= until {
                self.turns.insert(token);
                continue;
            }
            self.last_turn = token;
            self.take_turn(token, now);
        }
    }

    fn is_stranger(&self, token: usize) -> bool {
        self.router.client(token).is_some_and(|client| !self.router.is_known(client))
    }

    /// Handles the packets of a connection that have arrived, and reads more.
    fn take_turn(&mut self, token: usize, now: Instant) {
        let until = Instant::now() + TURN;
        let is_over = self.digest(token, now, until);
        let Some(connection) = self.connections.get_mut(&token) else { return };
        if is_over {
            self.turns.insert(token);
        }
        if is_over || connection.is_paused() || !connection.is_readable || self.router.is_flooded(token) {
            return connection.weigh();
        }
        if !connection.read(now, &mut self.scratch) {
            return self.end(token, now, false);
        }
        let is_over = self.digest(token, now, until);
        let Some(connection) = self.connections.get_mut(&token) else { return };
        connection.weigh();
        if is_over || (connection.is_readable && !connection.is_paused()) {
            self.turns.insert(token);
        }
    }
}
