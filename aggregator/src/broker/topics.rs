//! Topics and topic filters: which are valid, and which topic matches which filter.

/// Longest client id, topic and topic filter, bytes: four times the longest device id.
pub(super) const TEXT_BYTES_MAX: usize = 256;

/// Whether `text` may be the topic of a message.
pub(super) fn is_topic(text: &str) -> bool {
    is_text(text) && !text.contains(['+', '#'])
}

/// Whether `text` may be the filter of a subscription.
pub(super) fn is_filter(text: &str) -> bool {
    let mut levels = text.split('/').peekable();
    let mut is_valid = is_text(text);
    while let Some(level) = levels.next() {
        let is_last = levels.peek().is_none();
        is_valid &= match level {
            "#" => is_last,
            "+" => true,
            level => !level.contains(['+', '#']),
        };
    }
    is_valid
}

fn is_text(text: &str) -> bool {
    !text.is_empty() && text.len() <= TEXT_BYTES_MAX && !text.contains('\0')
}

/// Whether a topic matches a filter. Both must be valid. Wildcards at the first level do not match topics that begin
/// with `$`.
pub(super) fn matches(topic: &str, filter: &str) -> bool {
    !(topic.starts_with('$') && filter.starts_with(['+', '#'])) && covers(filter, topic)
}

/// Whether every topic that matches `filter` also matches `wider`. A topic is a filter without wildcards.
pub(super) fn covers(wider: &str, filter: &str) -> bool {
    let (mut wide, mut narrow) = (wider.split('/'), filter.split('/'));
    loop {
        match (wide.next(), narrow.next()) {
            (Some("#"), _) | (None, None) => return true,
            (Some("+"), Some(level)) if level != "#" => {}
            (Some(left), Some(right)) if left == right && right != "+" => {}
            _ => return false,
        }
    }
}

/// The start of a filter before its first wildcard: every topic that matches begins with it, or is it without the
/// trailing slash.
pub(super) fn fixed_start(filter: &str) -> &str {
    let end = filter.find(['+', '#']).unwrap_or(filter.len());
    filter[..end].strip_suffix('/').unwrap_or(&filter[..end])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn filters_match_as_the_standard_says() {
        for (topic, filter, expected) in [
            ("a/b", "a/b", true),
            ("a/b", "a/+", true),
            ("a/b", "#", true),
            ("a", "a/#", true),
            ("a/b/c", "a/+", false),
            ("a", "a/+", false),
            ("/a", "+/+", true),
            ("$SYS/a", "#", false),
            ("$SYS/a", "+/a", false),
            ("$SYS/a", "$SYS/#", true),
            ("é/b", "+/b", true),
            ("a//b", "a/+/b", true),
        ] {
            assert_eq!(matches(topic, filter), expected, "{topic} {filter}");
            assert!(!expected || topic.starts_with(fixed_start(filter)), "{topic} {filter}");
        }
    }

    #[test]
    fn a_filter_is_covered_only_by_one_that_is_at_least_as_wide() {
        for (wider, filter, expected) in [
            ("a/#", "a/+/c", true),
            ("a/+/c", "a/+/c", true),
            ("a/+", "a/#", false),
            ("a/b", "a/+", false),
            ("#", "#", true),
        ] {
            assert_eq!(covers(wider, filter), expected, "{wider} {filter}");
        }
    }

    #[test]
    fn wildcards_stand_alone() {
        for text in ["#", "+", "a/+/b", "a/#", "/", "$SYS/#"] {
            assert!(is_filter(text), "{text}");
        }
        for text in ["", "a#", "a/#/b", "+a", "a\0", &"x".repeat(257)] {
            assert!(!is_filter(text), "{text}");
        }
        assert!(is_topic("a/b") && !is_topic("a/+") && !is_topic("#") && !is_topic(""));
    }
}
