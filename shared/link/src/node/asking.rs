//! A device's side of the site's plan: while it waits for an answer, it repeats the start of its session.

use std::time::Duration;

use crate::pacing::{Backoff, PLAN_ASK, PLAN_ASKS_MAX};

/// The question for the device's cell. It is asked again a few times after each connection, until an answer arrives.
#[derive(Debug)]
pub(super) struct Asking {
    /// When the question is repeated; `None` if it is not.
    at: Option<Duration>,
    backoff: Backoff,
    asked: u32,
    is_answered: bool,
}

impl Default for Asking {
    fn default() -> Self {
        Self { at: None, backoff: PLAN_ASK, asked: 0, is_answered: false }
    }
}

impl Asking {
    /// The device is connected, and has told the start of its session.
    pub(super) fn on_connected(&mut self, now: Duration) {
        if !self.is_answered {
            (self.backoff, self.asked) = (PLAN_ASK, 0);
            self.at = Some(now + self.backoff.delay());
        }
    }

    /// An answer has arrived.
    pub(super) fn on_answer(&mut self) {
        (self.at, self.is_answered) = (None, true);
    }

    /// When the question is repeated.
    pub(super) fn next_wakeup(&self) -> Option<Duration> {
        self.at
    }

    /// Whether the question is due. The caller must ask it: it counts as asked.
    pub(super) fn is_due(&mut self, now: Duration) -> bool {
        if self.at.is_none_or(|at| now < at) {
            return false;
        }
        self.asked += 1;
        self.at = (self.asked < PLAN_ASKS_MAX).then(|| now + self.backoff.delay());
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_question_is_repeated_a_few_times_until_it_is_answered() {
        let asked = |asking: &mut Asking, seconds: u64| {
            (0..1000).filter(|i| asking.is_due(Duration::from_millis(1000 * seconds + 100 * i))).count()
        };
        let mut asking = Asking::default();
        assert_eq!(asked(&mut asking, 0), 0, "not connected");
        asking.on_connected(Duration::ZERO);
        assert_eq!(asked(&mut asking, 0), PLAN_ASKS_MAX as usize);
        asking.on_connected(Duration::from_secs(200));
        assert!(asking.is_due(Duration::from_secs(201)), "again after another connection");
        asking.on_answer();
        asking.on_connected(Duration::from_secs(202));
        assert_eq!((asked(&mut asking, 202), asking.next_wakeup()), (0, None));
    }
}
