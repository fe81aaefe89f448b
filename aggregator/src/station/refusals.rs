//! Tells of refused requests in the log: a few lines a minute, however many there are, so that a flood fills no disk and hides
//! nothing else.
//!
//! What it knows nothing about: why requests are refused.

use std::net::IpAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use axum::http::{Method, Uri};
use cosurf_contract::Escaped;
use tokio::runtime::Handle;
use tokio::time::sleep;
use tracing::warn;

/// Refusals that are told one by one in a [`PERIOD`].
const LINES: u64 = 5;
const PERIOD: Duration = Duration::from_secs(60);
/// Longest path that is told, characters.
const PATH_CHARS_MAX: usize = 60;

/// Gets a line for the log.
type Tell = Arc<dyn Fn(&str) + Send + Sync>;

/// The refusals of a server. Clones share their number.
#[derive(Clone)]
pub(super) struct Refusals {
    tell: Tell,
    period: Arc<Mutex<Period>>,
}

#[derive(Debug)]
struct Period {
    begun: Instant,
    length: Duration,
    count: u64,
}

impl Refusals {
    /// `tell` gets lines for the log of the page; all lines go to the log of the program, too.
    pub(super) fn new(tell: impl Fn(&str) + Send + Sync + 'static) -> Self {
        Self::told_every(PERIOD, tell)
    }

    fn told_every(length: Duration, tell: impl Fn(&str) + Send + Sync + 'static) -> Self {
        let period = Period { begun: Instant::now(), length, count: 0 };
        Self { tell: Arc::new(tell), period: Arc::new(Mutex::new(period)) }
    }

    /// Notes that a request was refused, and why.
    pub(super) fn note(&self, by: IpAddr, method: &Method, uri: &Uri, why: &str) {
        // Without the query, which may hold a token.
        let path: String = uri.path().chars().take(PATH_CHARS_MAX).collect();
        let line = format!("refused {method} {path} of {by}: {why}");
        let (lines, is_first_hidden, length) = {
            let mut period = self.period();
            (period.next(Instant::now(), line), period.count == LINES + 1, period.length)
        };
        lines.iter().for_each(|line| self.write(line));
        // A flood that has stopped is counted, too.
        if is_first_hidden && let Ok(runtime) = Handle::try_current() {
            let refusals = self.clone();
            runtime.spawn(async move {
                sleep(length).await;
                let rest = refusals.period().end(Instant::now());
                rest.iter().for_each(|line| refusals.write(line));
            });
        }
    }

    fn period(&self) -> MutexGuard<'_, Period> {
        self.period.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn write(&self, line: &str) {
        let line = Escaped(line).to_string();
        warn!("{line}");
        (self.tell)(&line);
    }
}

impl Period {
    /// The lines to tell for the next refusal.
    fn next(&mut self, now: Instant, line: String) -> Vec<String> {
        let mut lines: Vec<String> = self.end(now).into_iter().collect();
        self.count += 1;
        if self.count <= LINES {
            lines.push(line);
        }
        lines
    }

    /// If the period is over, begins another one. Returns the line with the number of refusals that were not told.
    fn end(&mut self, now: Instant) -> Option<String> {
        if now.saturating_duration_since(self.begun) < self.length {
            return None;
        }
        let more = self.count.saturating_sub(LINES);
        (self.begun, self.count) = (now, 0);
        (more > 0).then(|| format!("refused {more} more requests before"))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::sync::mpsc;

    use tokio::runtime::Builder;

    use super::*;

    #[test]
    fn a_flood_that_stops_is_counted() {
        let (lines, told) = mpsc::channel();
        let refusals = Refusals::told_every(Duration::from_millis(200), move |line| {
            lines.send(line.to_owned()).unwrap();
        });
        let flood = async {
            let (by, uri) = (IpAddr::from([10, 0, 0, 1]), "/api/merge".parse().unwrap());
            (0..20).for_each(|_| refusals.note(by, &Method::POST, &uri, "no token"));
            sleep(Duration::from_secs(1)).await;
        };
        Builder::new_current_thread().enable_all().build().unwrap().block_on(flood);
        let told: Vec<String> = told.try_iter().collect();
        assert_eq!((told.len(), &*told[5]), (6, "refused 15 more requests before"), "{told:?}");
    }

    #[test]
    fn a_flood_gives_a_few_lines_and_their_number() {
        let begun = Instant::now();
        let mut period = Period { begun, length: PERIOD, count: 0 };
        let told: usize = (0..10_000).map(|_| period.next(begun, "x".into()).len()).sum();
        assert_eq!(told, 5);
        let later = period.next(begun + PERIOD, "y".into());
        assert_eq!(later, ["refused 9995 more requests before", "y"]);
        (0..9).for_each(|_| _ = period.next(begun + PERIOD, "z".into()));
        assert_eq!(period.end(begun + PERIOD), None, "not over");
        assert_eq!(period.end(begun + 2 * PERIOD).as_deref(), Some("refused 5 more requests before"));
        assert_eq!(period.end(begun + 4 * PERIOD), None, "nothing was refused since");
    }
}
