//! Output for people at a terminal, shared by commands, missions and reports: progress, tables and durations.
//!
//! What it knows nothing about: missions and the service. It only formats and prints what it is given.
//!
//! Where to start reading: [`Meter`], the progress display of a long task.

mod display;
mod meter;
mod table;

pub use display::Display;
pub(crate) use display::format_seconds;
pub use meter::Meter;
pub(crate) use table::aligned;
