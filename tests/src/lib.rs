//! The testkit: what the tests and benches of several crates need, written once. Crates take it as a
//! dev-dependency; nothing that is shipped depends on it.
//!
//! - [`models`], [`offers`]: random splats, cameras, and uploads made of them.
//! - [`fleet`]: nodes on a simulated network and virtual time. [`radio`]: both ends of a simulated serial line.
//! - [`live`]: nodes over a real broker. [`mosquitto`]: Mosquitto as a child process, and certificates for it.
//! - [`datasets`]: synthetic towns and the datasets that benches use. [`programs`]: where cargo puts programs.
//! - [`skips`]: how a test says that it tested nothing. [`results`]: what benches measure, and the tables of the documents.
//!
//! Unit tests of a crate below the testkit cannot use its builders: they would get the types of another build of
//! their own crate. They can use [`skips`].

// A failing builder should fail the test that calls it.
#![allow(clippy::unwrap_used)]

pub mod datasets;
pub mod fleet;
pub mod live;
pub mod models;
pub mod mosquitto;
pub mod offers;
pub mod programs;
pub mod radio;
pub mod results;
pub mod skips;
