//! The testkit: code that the tests and benches of several crates share. Crates use it as a dev-dependency only, so
//! nothing that is shipped depends on it.
//!
//! - [`models`], [`offers`]: random splats, cameras, and uploads made of them.
//! - [`fleet`]: nodes on a simulated network, with virtual time. [`stranger`]: a stranger on that network.
//!   [`keys`]: keys of participants.
//!   [`radio`]: both ends of a simulated serial line.
//! - [`live`]: nodes that use a real broker. [`mqtt`]: the bytes of MQTT packets. [`mosquitto`]: Mosquitto as a child
//!   process, and certificates for it. [`nats`], [`s3`]: a NATS server and an S3 server as child processes.
//! - [`datasets`]: synthetic cities and the datasets that benches use. [`programs`]: the paths of the programs that
//!   cargo has built. [`running`]: such a program beside a test. [`dice`]: random numbers. [`mutate`]: changed samples.
//! - [`site`]: a service with a page, and its devices. [`chromium`]: a headless browser. [`axe`]: checks of its pages for
//!   people without a mouse or a screen.
//! - [`wine`]: programs for Windows under Wine.
//! - [`usage`]: the memory and time that a child process takes.
//! - [`slow_line`]: a line to a broker that is slow and breaks.
//!   [`web_door`]: a WebSocket listener in front of a broker.
//! - [`skips`]: how a test reports that it was skipped. [`results`]: the results of benches, and their tables in the
//!   documents.
//!
//! If the testkit depends on a crate (such as `cosurf-scene`), the unit tests of that crate cannot use the testkit's
//! builders: these return types of another build of the crate. Such unit tests can use [`skips`].

// A builder that fails should make the test that calls it fail.
#![allow(clippy::unwrap_used)]

pub mod axe;
pub mod chromium;
pub mod coordinates;
pub mod datasets;
pub mod dice;
pub mod fleet;
pub mod keys;
pub mod live;
pub mod models;
pub mod mosquitto;
pub mod mqtt;
pub mod mutate;
pub mod nats;
pub mod offers;
pub mod programs;
pub mod radio;
pub mod results;
pub mod running;
pub mod s3;
pub mod site;
pub mod skips;
pub mod slow_line;
pub mod stranger;
pub mod usage;
pub mod web_door;
pub mod wide_ground;
pub mod wine;
