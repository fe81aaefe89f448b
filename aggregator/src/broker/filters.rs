//! Which sessions subscribe to what: finds those whose filters match a topic without a look at the others.

use std::collections::BTreeMap;
use std::ops::Bound;

use super::client::Client;

/// Limit on the levels of a filter: twice those of cosurf's topics. Each level of a topic doubles the filters that may
/// match it.
pub(super) const FILTER_LEVELS_MAX: usize = 16;

/// A session that has a filter: its number, and its name.
type Holder = (u64, Client);

/// The filters of all sessions, in alphabetical order: filters with the same first levels stand together, so the search
/// goes on only with first levels that exist.
#[derive(Debug, Default)]
pub(super) struct Filters {
    holders: BTreeMap<Box<str>, Vec<Holder>>,
    held: usize,
}

impl Filters {
    /// Number of filters of all sessions together.
    pub(super) fn held(&self) -> usize {
        self.held
    }

    /// Notes that a session has a filter.
    pub(super) fn add(&mut self, filter: &str, number: u64, client: &Client) {
        let holders = match self.holders.get_mut(filter) {
            Some(holders) => holders,
            None => self.holders.entry(filter.into()).or_default(),
        };
        if let Err(place) = holders.binary_search_by_key(&number, |(number, _)| *number) {
            holders.insert(place, (number, client.clone()));
            self.held += 1;
        }
    }

    /// Notes that a session has a filter no longer.
    pub(super) fn remove(&mut self, filter: &str, number: u64) {
        let Some(holders) = self.holders.get_mut(filter) else { return };
        if let Ok(place) = holders.binary_search_by_key(&number, |(number, _)| *number) {
            holders.remove(place);
            self.held -= 1;
        }
        if holders.is_empty() {
            self.holders.remove(filter);
        }
    }

    /// The sessions with a filter that matches a topic, each once, the oldest first.
    pub(super) fn matching(&self, topic: &str) -> Vec<Client> {
        let mut search = Search { filters: self, start: String::new(), found: Vec::new() };
        // Wildcards at the first level do not match topics that begin with `$`.
        search.step(topic, !topic.starts_with('$'));
        search.found.sort_unstable_by_key(|(number, _)| *number);
        search.found.dedup_by_key(|(number, _)| *number);
        search.found.into_iter().map(|(_, client)| client.clone()).collect()
    }

    /// Whether a filter begins with `start`.
    fn go_on(&self, start: &str) -> bool {
        let mut after = self.holders.range::<str, _>((Bound::Included(start), Bound::Unbounded));
        after.next().is_some_and(|(filter, _)| filter.starts_with(start))
    }
}

/// A search for the filters that match a topic.
struct Search<'a> {
    filters: &'a Filters,
    /// The first levels of the filters that are looked at, which match those of the topic, with their slashes.
    start: String,
    found: Vec<&'a Holder>,
}

impl Search<'_> {
    /// Goes on with the topic's remaining levels.
    fn step(&mut self, rest: &str, may_be_wild: bool) {
        if may_be_wild {
            self.take("#");
        }
        let (level, rest) = rest.split_once('/').map_or((rest, None), |(level, rest)| (level, Some(rest)));
        let length = self.start.len();
        for candidate in [level, "+"].into_iter().take(1 + usize::from(may_be_wild)) {
            self.start.push_str(candidate);
            match rest {
                None => {
                    self.take("");
                    // `a/#` matches `a` too.
                    self.take("/#");
                }
                Some(rest) => {
                    self.start.push('/');
                    if self.filters.go_on(&self.start) {
                        self.step(rest, true);
                    }
                }
            }
            self.start.truncate(length);
        }
    }

    /// Takes the sessions with the filter that ends in `end`.
    fn take(&mut self, end: &str) {
        let length = self.start.len();
        self.start.push_str(end);
        self.found.extend(self.filters.holders.get(self.start.as_str()).into_iter().flatten());
        self.start.truncate(length);
    }
}

#[cfg(test)]
mod tests {
    use super::super::client::User;
    use super::super::topics::{is_filter, matches};
    use super::*;

    fn client(number: u64) -> Client {
        Client::new(User::Stranger, &number.to_string())
    }

    /// All topics and filters of up to three levels from an alphabet of levels.
    fn words(letters: &[&str]) -> Vec<String> {
        let mut all = vec![];
        let mut last: Vec<String> = vec![String::new()];
        for _ in 0..3 {
            let longer = |word: &String| -> Vec<String> {
                letters.iter().map(|letter| format!("{word}/{letter}")).collect()
            };
            last = last.iter().flat_map(longer).collect();
            all.extend(last.iter().map(|word| word[1..].to_owned()));
        }
        all
    }

    /// The search finds what comparing every filter with every topic finds.
    #[test]
    fn the_same_sessions_are_found_as_by_comparing_all() {
        let mut all = words(&["a", "ab", "$S", "", "+", "#"]);
        all.retain(|word| is_filter(word));
        let mut filters = Filters::default();
        for (number, filter) in all.iter().enumerate() {
            filters.add(filter, number as u64, &client(number as u64));
        }
        assert_eq!(filters.held(), all.len());
        let mut found = 0;
        for topic in words(&["a", "ab", "$S", "", "b"]).iter().filter(|topic| !topic.is_empty()) {
            let expected = (0..all.len()).filter(|number| matches(topic, &all[*number]));
            let expected: Vec<Client> = expected.map(|number| client(number as u64)).collect();
            assert_eq!(filters.matching(topic), expected, "{topic}");
            found += expected.len();
        }
        assert!(found > 1000, "{found}");
        for (number, filter) in all.iter().enumerate() {
            filters.remove(filter, number as u64);
        }
        assert_eq!((filters.held(), filters.holders.len()), (0, 0));
    }

    #[test]
    fn a_session_with_many_matching_filters_is_found_once() {
        let mut filters = Filters::default();
        for (number, filter) in [(2, "a/#"), (2, "a/+"), (1, "+/b"), (2, "a/b"), (2, "a/b")] {
            filters.add(filter, number, &client(number));
        }
        assert_eq!((filters.held(), filters.matching("a/b")), (4, vec![client(1), client(2)]));
        filters.remove("a/b", 2);
        filters.remove("a/b", 3);
        assert_eq!((filters.held(), filters.matching("a/b").len()), (3, 2));
    }
}
