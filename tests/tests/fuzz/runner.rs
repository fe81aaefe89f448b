//! Runs a decoder on changed samples, and checks the time and memory that it takes.

use std::env;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::time::{Duration, Instant};

use cosurf_tests::dice::Dice;
use cosurf_tests::mutate::mutated;

use crate::memory::peak_bytes_of;

/// Default number of executions of each decoder. Even the slowest decoder then takes less than a second.
const EXECUTIONS: u64 = 5_000;
/// Limit on the time of one execution. It is generous because the machine may be busy. A decoder that hangs exceeds
/// any limit.
const LONGEST: Duration = Duration::from_secs(5);

/// Interval of reports of progress.
const TELL_EVERY: Duration = Duration::from_secs(10);

/// A decoder under test.
pub(crate) struct Target<'a> {
    /// Name of the decoder, for messages.
    pub(crate) name: &'a str,
    /// Valid inputs.
    pub(crate) samples: Vec<Vec<u8>>,
    /// Recomputes the checksums of a changed sample.
    pub(crate) reseal: fn(&mut [u8]),
    /// Largest peak of memory, bytes, that the decoder may allocate, as a function of the input's size in bytes.
    pub(crate) bytes_max: fn(usize) -> usize,
}

/// The value of an environment variable, or the usual one if it is not set.
pub(crate) fn number(name: &str, usual: u64) -> u64 {
    env::var(name).map_or(usual, |text| text.parse().expect("a number"))
}

/// Runs `decode` on all samples, which it must accept, and then on changed samples, which it may refuse. `decode`
/// returns whether it accepted its input. Panics if `decode` panics, takes too long or allocates too much.
pub(crate) fn hammer(target: Target, mut decode: impl FnMut(&[u8]) -> bool) {
    for (i, sample) in target.samples.iter().enumerate() {
        assert!(decode(sample), "{}: sample {i} is valid and was refused", target.name);
    }
    let (first, executions) = (number("FUZZ_SEED", 0), number("FUZZ_EXECUTIONS", EXECUTIONS));
    let (begun, mut told, mut read) = (Instant::now(), Instant::now(), 0u64);
    for seed in first..first + executions {
        let mut dice = Dice(seed);
        let mut bytes = mutated(&mut dice, &target.samples);
        if dice.coin() {
            (target.reseal)(&mut bytes);
        }
        let started = Instant::now();
        if started.duration_since(told) > TELL_EVERY {
            told = started;
            eprintln!("{}: {} executions", target.name, seed - first);
        }
        let mut outcome = Ok(false);
        let peak = peak_bytes_of(|| outcome = catch_unwind(AssertUnwindSafe(|| decode(&bytes))));
        let mut took = started.elapsed();
        let case = format!("{}: FUZZ_SEED={seed} FUZZ_EXECUTIONS=1", target.name);
        match outcome {
            Ok(was_read) => read += u64::from(was_read),
            Err(panic) => {
                eprintln!("{case} panics");
                resume_unwind(panic);
            }
        }
        if took >= LONGEST {
            // The machine may have been busy, so try again. A decoder that hangs will hang again.
            let started = Instant::now();
            decode(&bytes);
            took = started.elapsed();
        }
        assert!(took < LONGEST, "{case} takes {took:?}");
        let allowed = (target.bytes_max)(bytes.len());
        assert!(peak <= allowed, "{case} allocates {peak} bytes for {}, of {allowed} allowed", bytes.len());
    }
    let rate = executions as f64 / begun.elapsed().as_secs_f64();
    println!(
        "{:<18} {executions:>9} executions from seed {first}, {rate:>7.0}/s, {read:>9} accepted",
        target.name
    );
}
