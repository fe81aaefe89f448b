//! Fuzzes whole conversations: honest devices and aggregators, a hostile participant, and a network with faults. All of them
//! run in one thread on simulated time, and a seed decides everything, so a seed repeats its conversation.
//!
//! The participants are the nodes that the programs run. `plan` says what a seed decides, `hostile` and `forgery` what the
//! hostile participant does, and `judge` what must hold ([`judge::Invariant`]).

mod broken;
mod cast;
mod forgery;
mod hostile;
mod judge;
mod member;
mod metered;
mod plan;
mod play;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::{Duration, Instant};

use crate::runner::number;
use play::{Figures, play};

/// Conversations that each of the two tests holds, unless `FUZZ_CONVERSATIONS` says otherwise.
const CONVERSATIONS: u64 = 2000;

#[test]
fn conversations_end_well_first_half() {
    hold(0);
}

#[test]
fn conversations_end_well_second_half() {
    hold(1);
}

/// Holds every second conversation, beginning with the first or the second.
fn hold(half: u64) {
    let (first, count) = (number("FUZZ_SEED", 0), number("FUZZ_CONVERSATIONS", 2 * CONVERSATIONS));
    let (begun, mut told) = (Instant::now(), Instant::now());
    let (mut most, mut held) = (Figures::default(), 0u64);
    for seed in (first..first + count).filter(|seed| seed % 2 == half) {
        let outcome = catch_unwind(AssertUnwindSafe(|| play(seed, None)));
        let case = format!("FUZZ_SEED={seed} FUZZ_CONVERSATIONS=1");
        match outcome {
            Ok(Ok(figures)) => most = most.with(&figures),
            Ok(Err(violation)) => panic!("{case}: {violation}"),
            Err(_) => panic!("{case} panics"),
        }
        held += 1;
        if told.elapsed() > Duration::from_secs(10) {
            told = Instant::now();
            eprintln!("conversations: {held} held");
        }
    }
    let rate = held as f64 / begun.elapsed().as_secs_f64();
    let Figures { late, hostile, received, heap_share } = most;
    println!(
        "conversations: {held} from seed {first}, {rate:.0} per second, {hostile} hostile messages, {received} received; \
         the latest model arrived {late:.1?} after the attack; at most {:.0} % of the memory",
        100.0 * heap_share
    );
}

impl Figures {
    /// The larger of the extremes, and the sums of the counts.
    fn with(self, other: &Self) -> Self {
        Self {
            late: self.late.max(other.late),
            hostile: self.hostile + other.hostile,
            received: self.received + other.received,
            heap_share: self.heap_share.max(other.heap_share),
        }
    }
}
