//! The ground side of cosurf: takes in what the drones send, joins it, sends it back.
//!
//! What it refuses to know: how agents train. It meets them by what arrives over the link.
//!
//! Where to start reading: [`service`], what runs in the field.

pub mod broker;
pub mod field;
mod merge;
pub mod service;
