//! What the command lines of `cosurf-agent` and `cosurf-aggregator` share.
//!
//! What it is:
//! - [`VERSION`]: what `--version` prints. [`ENDED_BY_SIGNAL`]: an exit code.
//! - [`shell`]: the commands `completions` and `man`.
//! - [`doctor`]: the checks of the command `doctor`.
//!
//! What it knows nothing about: what the programs do, their other commands and their configuration.
//!
//! Where to start reading: [`shell`].

pub mod doctor;
pub mod shell;

/// Version of the programs, with the commit that they were built from if it was known: `0.1.0 (0123456789)`.
pub const VERSION: &str = env!("COSURF_VERSION");

/// Exit code of a program that a signal has ended, as shells report it for Ctrl-C.
pub const ENDED_BY_SIGNAL: u8 = 130;
