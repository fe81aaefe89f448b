//! Decides when models are merged.

use std::collections::BTreeSet;
use std::time::Duration;

use cosurf_wire::DeviceId;

/// The devices that a service waits for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Expected {
    /// All of these devices: models are merged as soon as each device has sent one or is given up.
    Devices(BTreeSet<DeviceId>),
    /// Any devices: models are merged in rounds.
    Anybody(Rounds),
}

/// Conditions that end a round. A round begins with a change, for example when a model arrives, and ends with a merge.
/// It ends when `quorum` devices have sent a model and nothing further has changed for `quiet`, or at the latest after
/// `deadline`. Further models of a device that has sent one in this round change nothing, so a device that sends one
/// after the other does not postpone the merge.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rounds {
    /// Least number of devices with a model.
    pub quorum: usize,
    /// Time without a new model after which a round may end.
    pub quiet: Duration,
    /// Longest duration of a round.
    pub deadline: Duration,
}

impl Default for Rounds {
    fn default() -> Self {
        Self { quorum: 1, quiet: Duration::from_secs(5), deadline: Duration::from_secs(600) }
    }
}

/// A running round.
#[derive(Clone, Debug)]
pub(super) struct Round {
    /// Time at which the round began.
    begun: Duration,
    /// Time of the last change: a device's first model in this round, a command, a withdrawal or a failure.
    last: Duration,
    /// Devices whose models have extended the round.
    senders: BTreeSet<DeviceId>,
    /// True if the operator has ended the round.
    is_ended: bool,
}

impl Round {
    /// Begins a round, or extends `round`. The cause at `now` is a command, a withdrawal, or a failed merge or write that
    /// must be tried again.
    pub(super) fn extend(round: Option<Self>, now: Duration) -> Self {
        match round {
            Some(round) => Self { last: now, ..round },
            None => Self { begun: now, last: now, senders: BTreeSet::new(), is_ended: false },
        }
    }

    /// Ends `round`, or a new one, because the operator wants a merge.
    pub(super) fn at_once(round: Option<Self>, now: Duration) -> Self {
        Self { is_ended: true, ..Self::extend(round, now) }
    }

    /// Whether the operator has ended the round.
    pub(super) fn is_at_once(&self) -> bool {
        self.is_ended
    }

    /// Begins a round, or extends `round`, because a model of `device` has arrived.
    pub(super) fn extend_by(round: Option<Self>, device: DeviceId, now: Duration) -> Self {
        match round {
            Some(round) if round.senders.contains(&device) => round,
            round => {
                let mut round = Self::extend(round, now);
                round.senders.insert(device);
                round
            }
        }
    }

    /// Whether the round is over at `now`. The devices `here` have sent a model; the service does not wait for the
    /// devices `given_up`.
    pub(super) fn is_over(
        &self,
        expected: &Expected,
        here: &BTreeSet<DeviceId>,
        given_up: &BTreeSet<DeviceId>,
        now: Duration,
    ) -> bool {
        match expected {
            _ if self.is_ended => true,
            Expected::Devices(devices) => {
                devices.iter().all(|device| here.contains(device) || given_up.contains(device))
            }
            Expected::Anybody(rounds) => {
                let is_quiet = now >= self.last.saturating_add(rounds.quiet);
                let enough = here.len() >= rounds.quorum && is_quiet;
                enough || now >= self.begun.saturating_add(rounds.deadline)
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
        assert!(!round.is_over(&rounds, &one, &one, s(69)), "one device is no quorum");
        assert!(round.is_over(&rounds, &one, &one, s(70)), "the deadline ends the round");
        let ended = Round::at_once(Some(round.clone()), s(11));
        assert!(ended.is_over(&rounds, &one, &one, s(11)), "the operator ends the round");
        assert!(Round::extend_by(Some(ended), DeviceId::new("c").unwrap(), s(12)).is_over(
            &rounds,
            &one,
            &one,
            s(12)
        ));
        let round = Round::extend(Some(round), s(20));
        assert!(!round.is_over(&rounds, &two, &one, s(24)), "another model may follow soon");
        assert!(round.is_over(&rounds, &two, &one, s(25)));
        let round = Round::extend(Some(round), s(69));
        assert!(round.is_over(&rounds, &two, &one, s(70)), "a late arrival does not move the deadline");
        let never = Expected::Anybody(Rounds { quorum: 1, quiet: Duration::MAX, deadline: Duration::MAX });
        assert!(!round.is_over(&never, &two, &one, s(1 << 40)), "the longest times have no end");
    }

    #[test]
    fn a_device_extends_a_round_only_once() {
        let s = Duration::from_secs;
        let rounds = Expected::Anybody(Rounds { quorum: 1, quiet: s(5), deadline: s(60) });
        let [a, b] = ["a", "b"].map(|name| DeviceId::new(name).unwrap());
        let round = Round::extend_by(None, a, s(10));
        let round = Round::extend_by(Some(round), a, s(14));
        let is_over = |round: &Round, at| round.is_over(&rounds, &BTreeSet::from([a]), &BTreeSet::new(), at);
        assert!(is_over(&round, s(15)), "the second model postpones the merge");
        let round = Round::extend_by(Some(round), b, s(14));
        assert!(!is_over(&round, s(15)) && is_over(&round, s(19)), "another device may send one too");
    }
}
