//! What the commands ask of the machine: its terminal, cores and clock.

use std::io::{self, IsTerminal};
use std::thread::available_parallelism;
use std::time::{SystemTime, UNIX_EPOCH};

use cosurf_aggregator::Display;

/// Chooses how to show progress: JSON if asked for, bars on a terminal, else plain lines.
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

/// The session number: seconds since 1970, or 0 if the clock was never set.
pub(crate) fn session() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs())
}
