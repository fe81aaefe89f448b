//! Every decoder against bytes that nobody should send: samples of what is right, changed at random from a
//! seed, with the checksums put right again half of the time so that the damage is seen deeper inside.
//!
//! A decoder may refuse, or read something sane; it may not panic, take long, or take more memory than its
//! bytes could honestly need. `FUZZ_EXECUTIONS` says how many changed samples each decoder is given,
//! `FUZZ_SEED` where to begin: an execution is named by its seed, and done again by it alone.
#![allow(clippy::unwrap_used)]

mod body;
mod conversation;
mod files;
mod memory;
mod mutate;
mod runner;
