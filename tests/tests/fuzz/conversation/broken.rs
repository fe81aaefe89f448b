//! Each invariant can be violated: participants that are broken on purpose violate it in some conversation.

use super::judge::Invariant::{self, Genuine, Kept, Memory, Progress, Replies};
use super::member::Flaw;
use super::play::play;

/// Number of conversations in which a flaw must show.
const CONVERSATIONS: u64 = 4000;

/// A conversation shows that the participant `index` has a flaw, because it violates this invariant.
fn shows(index: usize, flaw: Flaw, invariant: Invariant) {
    let broken = (0..CONVERSATIONS).find_map(|seed| {
        let violation = play(seed, Some((index, flaw))).err()?;
        (violation.invariant == invariant).then_some((seed, violation))
    });
    let (seed, violation) = broken.expect("the flaw does not show");
    println!("{flaw:?} participant {index}, seed {seed}: {violation}");
}

#[test]
fn an_aggregator_that_acknowledges_without_storing_is_found() {
    shows(0, Flaw::Forgetful, Kept);
}

#[test]
fn a_drone_that_believes_strangers_is_found() {
    shows(1, Flaw::Trusting, Kept);
}

#[test]
fn an_aggregator_that_believes_strangers_is_found() {
    shows(0, Flaw::Trusting, Genuine);
    shows(0, Flaw::Trusting, Replies);
}

#[test]
fn an_aggregator_that_takes_too_much_memory_is_found() {
    shows(0, Flaw::Greedy, Memory);
}

#[test]
fn participants_that_say_too_much_are_found() {
    shows(0, Flaw::Talkative, Replies);
    shows(1, Flaw::Talkative, Replies);
}

#[test]
fn participants_that_say_nothing_are_found() {
    shows(0, Flaw::Mute, Progress);
    shows(1, Flaw::Mute, Progress);
}
