//! What the commands share to speak to a person at a terminal: how progress is shown, tables, durations.
//!
//! It refuses to know what a mission or a service is. It decides nothing and computes nothing that lasts.
//!
//! Where to start reading: [`Meter`], the progress of one long task.

mod display;
mod meter;
mod table;

pub use display::Display;
pub(crate) use display::format_seconds;
pub use meter::Meter;
pub(crate) use table::aligned;
