//! What the commands ask the computer for: whether standard error is a terminal, the number of cores, and the clock.

use std::io::{self, IsTerminal};
use std::thread::available_parallelism;
use std::time::{SystemTime, UNIX_EPOCH};

use cosurf_aggregator::Display;

/// Chooses how to show progress: as JSON if `json` is true, else as bars if standard error is a terminal, else as plain
/// lines.
pub(crate) fn display(json: bool) -> Display {
    match (json, io::stderr().is_terminal()) {
        (true, _) => Display::Json,
        (false, true) => Display::Bars,
        (false, false) => Display::Lines,
    }
}

pub(crate) fn cores() -> usize {
    available_parallelism().map_or(1, usize::from)
}

/// The number of a new session: seconds since 1970 by the computer's clock, or 0 if the clock is before 1970.
pub(crate) fn session() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs())
}
