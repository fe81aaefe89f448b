//! How much memory a service takes at most, by its settings.

use std::fmt;

use serde::Serialize;

use super::config::AggregatorConfig;

/// What a service takes beside its limits, bytes: messages on their way, the global model while it is packed and sent,
/// and what the allocator holds back. `tests/tests/storm` measures it.
const OTHER_BYTES: u64 = 64 << 20;

/// How much memory a service takes at most, bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(tag = "event", rename = "memory")]
pub struct MemoryBound {
    /// All of it.
    at_most_bytes: u64,
    /// For models that arrive; at an edge, also for those from above.
    uploads_bytes: u64,
    /// For the clients of the built-in broker; 0 without one.
    broker_bytes: u64,
    /// For merges, and for the program itself.
    merge_bytes: u64,
    /// For the page in a browser; 0 without one.
    page_bytes: u64,
    /// For the rest.
    other_bytes: u64,
}

impl MemoryBound {
    /// The bound of a service with this configuration, without a page. The memory of serial lines and of the operating system's buffers
    /// comes on top.
    pub fn of(config: &AggregatorConfig) -> Self {
        let inboxes = 1 + u64::from(config.upstream.is_some());
        let uploads_bytes = config.memory_bytes.saturating_mul(inboxes);
        let broker_bytes = if config.bind.is_some() { config.broker_memory_bytes as u64 } else { 0 };
        let (merge_bytes, other_bytes) = (config.merge_memory_bytes, OTHER_BYTES);
        let limits = [uploads_bytes, broker_bytes, merge_bytes, other_bytes];
        let at_most_bytes = limits.into_iter().fold(0, u64::saturating_add);
        Self { at_most_bytes, uploads_bytes, broker_bytes, merge_bytes, page_bytes: 0, other_bytes }
    }

    /// The same with a page that takes at most so many bytes.
    pub(super) fn with_page(self, page_bytes: u64) -> Self {
        Self { at_most_bytes: self.at_most_bytes.saturating_add(page_bytes), page_bytes, ..self }
    }

    /// All of it, bytes.
    pub fn at_most_bytes(&self) -> u64 {
        self.at_most_bytes
    }
}

impl fmt::Display for MemoryBound {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mib = |bytes: u64| bytes.div_ceil(1 << 20);
        write!(
            f,
            "memory: at most {} MiB: {} for uploads (`memory`), {} for the built-in broker (`broker_memory`), {} for merges \
             (`merge_memory`), ",
            mib(self.at_most_bytes),
            mib(self.uploads_bytes),
            mib(self.broker_bytes),
            mib(self.merge_bytes)
        )?;
        if self.page_bytes > 0 {
            write!(f, "{} for the page (`--http`), ", mib(self.page_bytes))?;
        }
        write!(f, "{} for the rest", mib(self.other_bytes))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn bound(settings: &str) -> MemoryBound {
        let config = format!("site = \"s\"\nout = \"o\"\nmemory_bytes = 1_048_576\n{settings}");
        MemoryBound::of(&toml::from_str(&config).unwrap())
    }

    #[test]
    fn the_bound_is_the_sum_of_the_limits_that_apply() {
        let with_broker = "merge_memory_bytes = 33_554_433\nbroker_memory_bytes = 16_777_216\n";
        let text = bound(&format!("{with_broker}bind = \"127.0.0.1:0\"\n")).to_string();
        assert!(text.starts_with("memory: at most 114 MiB: 1 for uploads"), "{text}");
        let without = bound("");
        let with = without.with_page(160 << 20);
        assert_eq!(with.at_most_bytes - without.at_most_bytes, 160 << 20);
        assert!(
            with.to_string().contains("160 for the page (`--http`)") && !without.to_string().contains("page")
        );
        assert_eq!(bound(with_broker).broker_bytes, 0, "the broker is elsewhere");
        let above = "[upstream]\nsite = \"a\"\ndevice = \"d\"\nbroker = \"mqtt://h:1\"\n";
        assert_eq!(bound(above).uploads_bytes, 2 << 20);
        assert_eq!(bound(&format!("merge_memory_bytes = {}\n", i64::MAX)).merge_bytes, i64::MAX as u64);
    }
}
