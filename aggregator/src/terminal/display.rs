//! The ways to show progress, and durations as text for people.

/// The way in which progress is shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Display {
    /// Bars on standard error, redrawn in place.
    Bars,
    /// Plain lines on standard error.
    Lines,
    /// Every event as a line of JSON on standard output, notices on standard error.
    Json,
}

/// Formats a duration for people: `47 s`, `3 min 05 s`, `2 h 07 min`. Negative durations count as 0. A duration that is
/// not finite is unknown and gives a dash.
pub(crate) fn format_seconds(seconds: f64) -> String {
    if !seconds.is_finite() {
        return "–".into();
    }
    let whole = seconds.round().max(0.0) as u64;
    match whole {
        0..60 => format!("{whole} s"),
        60..3600 => format!("{} min {:02} s", whole / 60, whole % 60),
        _ => format!("{} h {:02} min", whole / 3600, whole % 3600 / 60),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_are_readable() {
        for (seconds, text) in [
            (0.4, "0 s"),
            (59.4, "59 s"),
            (59.6, "1 min 00 s"),
            (185.0, "3 min 05 s"),
            (7620.0, "2 h 07 min"),
            (f64::INFINITY, "–"),
        ] {
            assert_eq!(format_seconds(seconds), text);
        }
    }
}
