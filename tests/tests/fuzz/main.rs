//! Every decoder against damaged bytes: valid samples, changed at random from a seed. Half of the time the checksums
//! are recomputed, so that the damage reaches the code behind them.
//!
//! A decoder may refuse its input or read valid values; it may not panic, take long, or allocate more memory than its
//! input justifies. `FUZZ_EXECUTIONS` is the number of changed samples for each decoder, `FUZZ_SEED` the first seed:
//! a failure names its seed, which repeats it alone.
#![allow(clippy::unwrap_used)]

mod body;
mod conversation;
mod files;
mod memory;
mod mutate;
mod runner;
