//! How often something may happen.

use std::time::Duration;

/// Allows some events at once, and one more after each interval.
#[derive(Debug)]
pub(super) struct Pace {
    at_once: u32,
    every: Duration,
    /// The time until which the events so far count.
    until: Duration,
}

impl Pace {
    /// Allows `at_once` events, and one more `every` so often.
    pub(super) fn new(at_once: u32, every: Duration) -> Self {
        Self { at_once, every, until: Duration::ZERO }
    }

    /// Whether an event may happen now; it then counts.
    pub(super) fn allows(&mut self, now: Duration) -> bool {
        let until = self.until.max(now) + self.every;
        let is_allowed = until <= now + self.every * self.at_once;
        if is_allowed {
            self.until = until;
        }
        is_allowed
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flood_is_slowed_down_and_a_slow_source_is_not() {
        let ms = Duration::from_millis;
        let mut pace = Pace::new(16, ms(400));
        let passed = (0..10_000).filter(|i| pace.allows(ms(*i))).count();
        assert_eq!(passed, 16 + 10_000 / 400 - 1);
        let mut pace = Pace::new(1, ms(400));
        assert!((0..100).all(|i| pace.allows(ms(400 * i))));
        assert!(!pace.allows(ms(400 * 99 + 399)) && pace.allows(ms(400 * 100)));
    }
}
