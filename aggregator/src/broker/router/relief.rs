//! What goes when the memory is full: messages of whoever keeps the most, oldest first. A user answers for all of its
//! clients together.

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use super::super::client::{Client, Party};
use super::super::session::Session;
use super::Router;

/// Share of the memory that is freed at once, as a divisor. The more is freed, the rarer the search for what must go.
const FREE_DIVISOR: usize = 16;
/// How long the messages of whoever keeps the most are refused without another look.
const REFUSE_FOR: Duration = Duration::from_millis(200);

impl Router {
    /// Makes room for `bytes` of a client; false if its own party keeps the most, or nothing can go.
    pub(super) fn make_room(&mut self, publisher: &Client, now: Instant, bytes: usize) -> bool {
        if !self.budget.lacks(bytes) {
            return true;
        }
        if self
            .refusing
            .as_ref()
            .is_some_and(|(client, until)| client.party() == publisher.party() && now < *until)
        {
            return false;
        }
        let goal = self.budget.max() - self.budget.max() / FREE_DIVISOR - bytes.min(self.budget.max() / 2);
        for client in self.heaviest_first() {
            if client.party() == publisher.party() {
                self.refusing = Some((client, now + REFUSE_FOR));
                return !self.budget.lacks(bytes);
            }
            if self.relieve(&client, goal) {
                break;
            }
        }
        !self.budget.lacks(bytes)
    }

    /// Drops what clients keep until the memory suffices again.
    pub(in super::super) fn keep_bound(&mut self) {
        if self.budget.lacks(0) {
            let goal = self.budget.max() - self.budget.max() / FREE_DIVISOR;
            let clients = self.heaviest_first();
            let _ = clients.iter().any(|client| self.relieve(client, goal));
        }
    }

    /// All clients but the parts of this program, in the order in which they lose messages: strangers before known
    /// clients, and those whose party keeps the most first.
    fn heaviest_first(&self) -> Vec<Client> {
        let mut weights: BTreeMap<&Client, usize> = self.retained.owners().collect();
        for (client, session) in &self.sessions {
            *weights.entry(client).or_default() += session.weight();
        }
        weights.retain(|client, _| !client.is_house());
        let mut parties: BTreeMap<Party, usize> = BTreeMap::new();
        weights.iter().for_each(|(client, weight)| *parties.entry(client.party()).or_default() += weight);
        let rank = |client: &Client, weight: usize| {
            let of_party = parties.get(&client.party()).copied().unwrap_or_default();
            (self.is_known(client), Reverse(of_party), Reverse(weight), client.clone())
        };
        let mut order: Vec<_> = weights.iter().map(|(client, weight)| rank(client, *weight)).collect();
        order.sort();
        order.into_iter().map(|(.., client)| client).collect()
    }

    /// Drops a client's messages, oldest first, until no more than `goal` bytes are used. Of a client that is away,
    /// the session goes too. Returns whether the goal is reached.
    fn relieve(&mut self, client: &Client, goal: usize) -> bool {
        while self.budget.used() > goal {
            let has_dropped = self.sessions.get_mut(client).is_some_and(Session::drop_oldest)
                || self.retained.drop_oldest(client);
            if !has_dropped {
                // Its last will goes too: to publish it would need the memory that is lacking.
                if self.sessions.get(client).is_some_and(|session| session.link.is_none()) {
                    self.remove_session(client);
                }
                break;
            }
            self.lost += 1;
        }
        self.budget.used() <= goal
    }
}
