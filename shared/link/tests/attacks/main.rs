//! Attacks of strangers on the broker, and of participants that misbehave. Each was successful against version 0.1, and its
//! number is the one that `shared/docs/OPERATING.md` gives it. Attacks 9 and 18 are tested beside the service
//! (`aggregator/src/service/tests/attacks.rs`), and 12 in the agent too (`agent/src/publish.rs`).
#![allow(clippy::unwrap_used)]

mod flights;
mod lost;
mod numbers;
mod plan;
mod replies;
mod resends;
mod retained;
mod room;
mod site;
mod sites;
