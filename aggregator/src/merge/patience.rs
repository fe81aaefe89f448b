//! How long a merge waits for its workers. It follows from how fast they were.

use std::time::{Duration, Instant};

/// Workers are taken for absent after so many times the longest wait for a result so far.
const TIMES: u32 = 3;

/// The patience with workers.
#[derive(Debug)]
pub(super) struct Patience {
    /// Since when no result has come.
    since: Instant,
    /// The shortest wait that is too long.
    least: Duration,
    /// The longest wait that ended with a result in time.
    longest: Duration,
}

impl Patience {
    pub(super) fn new(least: Duration, now: Instant) -> Self {
        Self { since: now, least, longest: Duration::ZERO }
    }

    /// A worker has given a result.
    pub(super) fn renew(&mut self, now: Instant) {
        if !self.is_over(now) {
            self.longest = self.longest.max(now - self.since);
        }
        self.since = now;
    }

    /// Whether no result has come for too long.
    pub(super) fn is_over(&self, now: Instant) -> bool {
        now - self.since > self.limit()
    }

    /// The wait that is too long.
    pub(super) fn limit(&self) -> Duration {
        self.least.max(TIMES * self.longest)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slow_workers_get_more_time_and_absent_ones_do_not() {
        let begun = Instant::now();
        let at = |seconds| begun + Duration::from_secs(seconds);
        let mut patience = Patience::new(Duration::from_secs(60), begun);
        assert!(!patience.is_over(at(60)) && patience.is_over(at(61)));
        patience.renew(at(50));
        assert!(!patience.is_over(at(200)) && patience.is_over(at(201)), "three times 50 s");
        patience.renew(at(10_000)); // too late to count as slow
        patience.renew(at(10_001));
        assert!(!patience.is_over(at(10_151)) && patience.is_over(at(10_152)));
    }
}
