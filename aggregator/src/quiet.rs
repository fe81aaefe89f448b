//! Limits how many messages of one source are reported. So nobody fills the log.

use std::collections::BTreeMap;
use std::time::Duration;

use cosurf_wire::DeviceId;

/// Messages of a source that are reported one by one in a [`PERIOD`].
const LINES: u64 = 5;
/// Time after which the other messages of a source are reported together.
const PERIOD: Duration = Duration::from_secs(60);
/// Limit on the sources that are told apart. Further ones count as one.
const SOURCES_MAX: usize = 64;

/// The ignored messages of each source; `None` for those that tell no source, and for sources beyond the limit.
#[derive(Debug, Default)]
pub(crate) struct Quiet {
    sources: BTreeMap<Option<DeviceId>, Ignored>,
}

#[derive(Debug)]
struct Ignored {
    begun: Duration,
    count: u64,
}

impl Quiet {
    /// Counts an ignored message. Returns whether it must be reported.
    pub(crate) fn notes(&mut self, now: Duration, source: Option<DeviceId>) -> bool {
        let is_known = self.sources.contains_key(&source);
        let source = source.filter(|_| is_known || self.sources.len() < SOURCES_MAX);
        let ignored = self.sources.entry(source).or_insert(Ignored { begun: now, count: 0 });
        ignored.count += 1;
        ignored.count <= LINES
    }

    /// A source and the number of its messages that were not reported one by one, once their period is over; `None` if
    /// there is none.
    pub(crate) fn summary(&mut self, now: Duration) -> Option<(Option<DeviceId>, u64)> {
        let is_over = |ignored: &Ignored| now.saturating_sub(ignored.begun) >= PERIOD;
        while let Some(source) =
            self.sources.iter().find(|(_, ignored)| is_over(ignored)).map(|(key, _)| *key)
        {
            let more = self.sources.remove(&source).map_or(0, |ignored| ignored.count.saturating_sub(LINES));
            if more > 0 {
                return Some((source, more));
            }
        }
        None
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_flood_of_messages_gives_a_few_lines() {
        let mut quiet = Quiet::default();
        let second = Duration::from_secs;
        let mut lines = Vec::new();
        for i in 0..20_000 {
            let source = (i % 2 == 0).then(|| DeviceId::new(&format!("d{}", i % 200)).unwrap());
            lines.extend(quiet.notes(second(i / 1000), source).then(|| "one".to_owned()));
            assert_eq!(quiet.summary(second(i / 1000)), None);
        }
        assert!(lines.len() <= (SOURCES_MAX + 1) * LINES as usize, "{}", lines.len());
        let summaries: Vec<(Option<DeviceId>, u64)> =
            std::iter::from_fn(|| quiet.summary(second(80))).collect();
        assert_eq!(summaries.iter().map(|(_, more)| *more as usize).sum::<usize>() + lines.len(), 20_000);
        assert!(summaries.contains(&(DeviceId::new("d0").ok(), 95)), "{summaries:?}");
        assert!(quiet.notes(second(90), DeviceId::new("d0").ok()), "a new period");
    }
}
