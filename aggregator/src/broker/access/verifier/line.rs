//! A line in which addresses have their turns, so that none keeps the others waiting.

use std::collections::{BTreeMap, VecDeque};
use std::net::{IpAddr, Ipv6Addr};

/// Limit on jobs that wait.
const JOBS_MAX: usize = 64;

/// Jobs that wait, by the addresses that they came from.
pub(super) struct Line<T> {
    /// The jobs of each address. Addresses that go first come first.
    jobs: BTreeMap<(Class, IpAddr), VecDeque<T>>,
    /// The address that was last served.
    served: Option<(Class, IpAddr)>,
}

/// Whether an address goes first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Class {
    First,
    Other,
}

impl<T> Default for Line<T> {
    fn default() -> Self {
        Self { jobs: BTreeMap::new(), served: None }
    }
}

impl<T> Line<T> {
    /// Adds a job of an address. Returns the job that gives way because too many wait: the newest of the address that has
    /// the most, and of one that does not go first if there is any.
    pub(super) fn join(&mut self, address: IpAddr, is_first: bool, job: T) -> Option<T> {
        let class = if is_first { Class::First } else { Class::Other };
        self.jobs.entry((class, network(address))).or_default().push_back(job);
        let waiting: usize = self.jobs.values().map(VecDeque::len).sum();
        if waiting <= JOBS_MAX {
            return None;
        }
        let heaviest = self.jobs.iter().max_by_key(|((class, _), jobs)| (*class, jobs.len()));
        let heaviest = heaviest.map(|(key, _)| *key)?;
        self.remove(heaviest, VecDeque::pop_back)
    }

    /// Removes the job whose turn it is.
    pub(super) fn next(&mut self) -> Option<T> {
        let first = *self.jobs.keys().next()?;
        let after = self.served.and_then(|served| self.jobs.keys().find(|key| **key > served).copied());
        // A turn may pass to the next address only among those that go first, or if there are none.
        let key = after.filter(|key| key.0 == first.0).unwrap_or(first);
        self.served = Some(key);
        self.remove(key, VecDeque::pop_front)
    }

    fn remove(&mut self, key: (Class, IpAddr), take: impl Fn(&mut VecDeque<T>) -> Option<T>) -> Option<T> {
        let jobs = self.jobs.get_mut(&key)?;
        let job = take(jobs);
        if jobs.is_empty() {
            self.jobs.remove(&key);
        }
        job
    }
}

/// What counts as one address: with IPv6, everybody has 2⁶⁴ of them.
fn network(address: IpAddr) -> IpAddr {
    match address {
        IpAddr::V4(_) => address,
        IpAddr::V6(ip) => Ipv6Addr::from_bits(ip.to_bits() >> 64 << 64).into(),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn address(text: &str) -> IpAddr {
        text.parse().unwrap()
    }

    #[test]
    fn who_guesses_passwords_keeps_nobody_waiting() {
        let mut line = Line::default();
        let lost =
            (0..500).filter_map(|i| line.join(address("10.0.0.9"), false, format!("guess {i}"))).count();
        assert_eq!(lost, 500 - JOBS_MAX);
        // A new address has a place, and its turn comes soon.
        assert!(line.join(address("10.0.0.10"), false, "right".to_owned()).unwrap().starts_with("guess"));
        let served: Vec<String> = (0..2).map(|_| line.next().unwrap()).collect();
        assert!(served.contains(&"right".to_owned()), "{served:?}");
        // One from which a right password came goes first.
        line.join(address("10.0.0.200"), true, "known".to_owned());
        assert_eq!(line.next().unwrap(), "known");
        let mut left = 0;
        while line.next().is_some() {
            left += 1;
        }
        assert_eq!(left, JOBS_MAX - 2);
    }

    #[test]
    fn a_network_of_ipv6_is_one_address() {
        let mut line = Line::default();
        for i in 0..500u16 {
            line.join(address(&format!("2001:db8::{i:x}")), false, "guess");
        }
        line.join(address("2001:db8:1::1"), false, "right");
        assert_eq!(line.jobs.len(), 2);
        let served = [line.next().unwrap(), line.next().unwrap()];
        assert!(served.contains(&"right"), "{served:?}");
    }

    #[test]
    fn guesses_never_take_the_place_of_those_that_go_first() {
        let mut line = Line::default();
        for i in 0..JOBS_MAX {
            assert!(line.join(address(&format!("10.0.1.{i}")), true, "known").is_none());
        }
        assert_eq!(line.join(address("10.0.0.9"), false, "guess"), Some("guess"));
    }
}
