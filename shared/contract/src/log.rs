//! The log of `cosurf-agent` and `cosurf-aggregator`: which spans and events are written, and in which format. Both
//! programs have the same options.
//!
//! A span is a named piece of work (crate `tracing`). The libraries open a span for each stage (level `info`), for
//! parts of a stage (`debug`), and for each step and pass (`trace`). When a span closes, the log writes a line with the
//! time that the work took. The log measures this time, so the libraries need not read a clock.

use std::fmt;
use std::io;
use std::str::FromStr;

use tracing_subscriber::Layer;
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::fmt::format::FmtSpan;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;

/// Format of the lines of the log.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LogFormat {
    /// Text for people.
    #[default]
    Text,
    /// One JSON object per line.
    Json,
}

/// Why the log cannot be started.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum LogError {
    /// A part of the filter is neither a level nor of the form `target=level`.
    #[error("--log {0:?}: write error, warn, info, debug or trace, or a list like info,cosurf_engine=trace")]
    Filter(String),
    /// [`start`] was called before.
    #[error("the log has already been started")]
    Started,
}

impl FromStr for LogFormat {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text {
            "text" => Ok(Self::Text),
            "json" => Ok(Self::Json),
            _ => Err("give text or json"),
        }
    }
}

impl fmt::Display for LogFormat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Text => "text",
            Self::Json => "json",
        })
    }
}

/// Starts the log of this process; it is written to standard error. `filter` is a level, or a list of levels and
/// `target=level` separated by commas. A target is a crate or a module. A span or event that the filter excludes costs
/// one comparison.
pub fn start(filter: &str, format: LogFormat) -> Result<(), LogError> {
    let targets = parse_filter(filter)?;
    // By default, a failed write of the log is reported by `eprintln!`, which panics if standard error is closed. A
    // closed standard error must not end the program.
    let lines = tracing_subscriber::fmt::layer()
        .with_span_events(FmtSpan::CLOSE)
        .with_writer(io::stderr)
        .log_internal_errors(false);
    let lines = match format {
        LogFormat::Text => lines.boxed(),
        LogFormat::Json => lines.json().boxed(),
    };
    tracing_subscriber::registry().with(lines).with(targets).try_init().map_err(|_| LogError::Started)
}

/// Parses a filter. It is stricter than the parser of [`Targets`], which takes a misspelt level for a target.
fn parse_filter(text: &str) -> Result<Targets, LogError> {
    let wrong = || LogError::Filter(text.to_owned());
    let level = |name: &str| {
        let is_name = name.starts_with(|first: char| first.is_ascii_alphabetic());
        name.parse::<LevelFilter>().ok().filter(|_| is_name).ok_or_else(wrong)
    };
    text.split(',').map(str::trim).try_fold(Targets::new(), |targets, part| match part.split_once('=') {
        Some(("", _)) => Err(wrong()),
        Some((target, name)) => Ok(targets.with_target(target, level(name)?)),
        None => Ok(targets.with_default(level(part)?)),
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_filter_is_a_level_or_a_list_of_targets_with_levels() {
        let filter = |text: &str| parse_filter(text).unwrap();
        assert_eq!(filter("debug").default_level(), Some(LevelFilter::DEBUG));
        let mixed = filter("info, cosurf_engine=trace,cosurf_link=off");
        assert_eq!(mixed.default_level(), Some(LevelFilter::INFO));
        let targets: Vec<_> = mixed.iter().map(|(target, level)| (target.to_owned(), level)).collect();
        assert!(targets.contains(&("cosurf_engine".to_owned(), LevelFilter::TRACE)), "{targets:?}");
        assert!(targets.contains(&("cosurf_link".to_owned(), LevelFilter::OFF)), "{targets:?}");
        assert_eq!(filter("cosurf_link=debug").default_level(), None);
    }

    #[test]
    fn a_wrong_filter_is_refused_with_an_example() {
        for text in ["", "loud", "3", "info,", "cosurf_engine=loud", "cosurf_engine=", "=info", "a=b=info"] {
            let error = parse_filter(text).unwrap_err();
            assert_eq!(error, LogError::Filter(text.to_owned()));
            assert!(
                error.to_string().contains("info,cosurf_engine=trace") && !error.to_string().contains('\n')
            );
        }
    }

    #[test]
    fn formats_are_written_as_they_are_read() {
        for format in [LogFormat::Text, LogFormat::Json] {
            assert_eq!(format.to_string().parse(), Ok(format));
        }
        assert!("xml".parse::<LogFormat>().is_err());
    }
}
