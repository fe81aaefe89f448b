//! The ground side of cosurf: takes in what the drones send, joins it, sends it back.
//!
//! What it refuses to know: how agents train. It meets them by what arrives over the link, and in a
//! [`mission`], where it starts them as processes, by the orders it writes and the events they print.
//!
//! Where to start reading: [`service`], what runs in the field; then [`mission`], which runs service and
//! agents on one machine and leaves a report.

pub mod broker;
pub mod evaluate;
pub mod gate;
pub mod gateway;
pub mod merge;
pub mod mesh;
pub mod mission;
pub mod partition;
pub mod report;
pub mod service;
mod terminal;
#[cfg(test)]
mod testing;

pub use terminal::{Display, Meter};
