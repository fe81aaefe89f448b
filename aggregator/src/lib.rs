//! The ground station of cosurf: receives the models that drones send, merges them, and sends the global model back.
//!
//! What it knows nothing about: how agents train. The service knows agents only by their messages over the link. A
//! [`mission`] also starts agents as processes: it writes their configuration files and reads the events that they
//! print.
//!
//! Where to start reading: [`service`], which runs on the ground station; then [`mission`], which runs the service and
//! the agents on one machine and writes a report.
//!
//! The modules. Each one is listed below the modules that use it:
//!
//! ```text
//! mission                     pictures to report on one machine
//!  ├─ georeference            where on the earth, taken over from a dataset or models
//!  ├─ outputs                 mesh and report of a global model, without photographs
//!  │   └─ survey              what a surveyor delivers of a georeferenced model
//!  ├─ report                  figures, tables and pages
//!  ├─ service                 models in, global model out
//!  │   ├─ gate ─► merge       which models take part; many models to one
//!  │   │           └─ store, queue   tiles that need not be computed again; tasks for workers
//!  │   └─ broker, gateway     MQTT without another program; devices on serial lines
//!  ├─ evaluate                how good a model or a mesh is
//!  ├─ partition               which agent gets which ground
//!  ├─ views                   pictures of a model in a file, within a limit of memory
//!  └─ terminal ─► mesh        progress for people; depth to triangles
//! ```
//!
//! [`viewer`] stands below `report`: a model that people walk through in a browser. [`station`] serves it, and shows what
//! services and missions note on its board.
//! [`worker`] stands beside `service`: it distils tiles for merges on other computers. [`pki`] stands alone: it makes the
//! keys of a site. `quiet` limits lines in the log, `colors` gives each device its colour, `scratch` holds what does not fit into
//! the memory.
//!
//! No module uses a module above it, and no file uses a file above it. If two files need the same type, it is in a
//! third file below both.

pub mod broker;
mod colors;
pub mod evaluate;
pub mod gate;
pub mod gateway;
pub mod georeference;
pub mod merge;
pub mod mesh;
pub mod mission;
pub mod outputs;
pub mod partition;
pub mod pki;
pub mod queue;
mod quiet;
pub mod report;
mod scratch;
pub mod service;
pub mod station;
pub mod store;
pub mod survey;
mod terminal;
#[cfg(test)]
mod testing;
pub mod viewer;
mod views;
pub mod worker;

pub use terminal::{Display, Meter};
