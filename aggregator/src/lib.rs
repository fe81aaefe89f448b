//! The ground side of cosurf: takes in what the drones send, joins it, sends it back.
//!
//! What it refuses to know: how agents train. It knows them by their messages over the link. A [`mission`]
//! also starts them as processes: it writes their configuration and reads the events that they print.
//!
//! Where to start reading: [`service`], what runs in the field; then [`mission`], which runs service and
//! agents on one machine and leaves a report.
//!
//! The modules, each below those that use it:
//!
//! ```text
//! mission                     pictures to report on one machine
//!  ├─ report                  figures, table and page of a mission
//!  ├─ service                 models in, global model out
//!  │   ├─ gate ─► merge       which models take part; many models to one
//!  │   └─ broker, gateway     MQTT without another program; devices on serial lines
//!  ├─ evaluate                how good a model or a mesh is
//!  ├─ partition               which agent gets which ground
//!  └─ terminal ─► mesh        progress for people; depth to triangles
//! ```
//!
//! No module or file uses one above it: a type that two of them need lies in a file below both.

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
