//! When models are merged.

use std::collections::BTreeSet;
use std::time::Duration;

use cosurf_wire::DeviceId;

/// Whom a service waits for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Expected {
    /// Each of these devices: models are merged as soon as the last has sent one.
    Devices(BTreeSet<DeviceId>),
    /// Anybody: models are merged in rounds.
    Anybody(Rounds),
}

/// A round begins when a model arrives and ends with a merge: once enough devices have sent one and no more have
/// come for a while, or when it has lasted long enough.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rounds {
    /// Devices that are enough.
    pub quorum: usize,
    /// How long no model must have come.
    pub quiet: Duration,
    /// How long a round lasts at most.
    pub deadline: Duration,
}

impl Default for Rounds {
    fn default() -> Self {
        Self { quorum: 1, quiet: Duration::from_secs(5), deadline: Duration::from_secs(600) }
    }
}

/// A round under way.
#[derive(Clone, Copy, Debug)]
pub(super) struct Round {
    begun: Duration,
    last: Duration,
}

impl Round {
    /// Something came at `now`: a round begins, or goes on.
    pub(super) fn extend(round: Option<Self>, now: Duration) -> Self {
        Self { begun: round.map_or(now, |round| round.begun), last: now }
    }

    /// Whether it ends at `now`, where models of `here` count and `given_up` are not waited for.
    pub(super) fn is_over(
        &self,
        expected: &Expected,
        here: &BTreeSet<DeviceId>,
        given_up: &BTreeSet<DeviceId>,
        now: Duration,
    ) -> bool {
        match expected {
            Expected::Devices(devices) => {
                devices.iter().all(|device| here.contains(device) || given_up.contains(device))
            }
            Expected::Anybody(rounds) => {
                let enough = here.len() >= rounds.quorum && now >= self.last + rounds.quiet;
                enough || now >= self.begun + rounds.deadline
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_round_ends_with_quorum_and_quiet_or_at_its_deadline() {
        let s = Duration::from_secs;
        let rounds = Expected::Anybody(Rounds { quorum: 2, quiet: s(5), deadline: s(60) });
        let devices = |names: &[&str]| names.iter().map(|name| DeviceId::new(name).unwrap()).collect();
        let (one, two): (BTreeSet<_>, BTreeSet<_>) = (devices(&["a"]), devices(&["a", "b"]));
        let round = Round::extend(None, s(10));
        assert!(!round.is_over(&rounds, &one, &one, s(69)), "one is not enough");
        assert!(round.is_over(&rounds, &one, &one, s(70)), "but for the deadline");
        let round = Round::extend(Some(round), s(20));
        assert!(!round.is_over(&rounds, &two, &one, s(24)), "another may come at once");
        assert!(round.is_over(&rounds, &two, &one, s(25)));
        let round = Round::extend(Some(round), s(69));
        assert!(round.is_over(&rounds, &two, &one, s(70)), "a late arrival does not move the deadline");
    }
}
