//! Fuzzes every decoder with valid samples that are changed at random. In half of the cases the checksums are
//! recomputed, so that the damage reaches the code that runs after the checksums are verified.
//!
//! A decoder may refuse its input or read valid values. It must not panic, take long, or allocate more memory than
//! its input justifies. The environment variable `FUZZ_EXECUTIONS` is the number of changed samples for each decoder,
//! and `FUZZ_SEED` is the seed of the first. A failure prints the values of both that repeat this failure alone.
#![allow(clippy::unwrap_used)]

mod body;
mod conversation;
mod files;
mod memory;
mod messages;
mod runner;
mod serial;
mod stored;
