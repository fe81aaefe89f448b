//! Runs a decoder on changed samples, and checks its time and memory.

use std::env;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::time::{Duration, Instant};

use crate::memory::peak_bytes_of;
use crate::mutate::{Random, mutated};

/// Executions of each decoder by default: below a second for the slowest.
const EXECUTIONS: u64 = 5_000;
/// Longest time of one execution. Generous: the machine may be busy, and a decoder that hangs takes for ever.
const LONGEST: Duration = Duration::from_secs(5);

/// A decoder under test.
pub(crate) struct Target<'a> {
    /// Its name.
    pub(crate) name: &'a str,
    /// Valid inputs.
    pub(crate) samples: Vec<Vec<u8>>,
    /// Recomputes the checksums of a changed sample.
    pub(crate) reseal: fn(&mut [u8]),
    /// Limit on its allocations, for an input of the given number of bytes.
    pub(crate) bytes_max: fn(usize) -> usize,
}

/// Runs `decode`, which returns whether it accepted its input, on changed samples and on the samples themselves.
pub(crate) fn hammer(target: Target, mut decode: impl FnMut(&[u8]) -> bool) {
    for (i, sample) in target.samples.iter().enumerate() {
        assert!(decode(sample), "{}: sample {i} is valid and was refused", target.name);
    }
    let number = |name: &str, usual| env::var(name).map_or(usual, |text| text.parse().expect("a number"));
    let (first, executions) = (number("FUZZ_SEED", 0), number("FUZZ_EXECUTIONS", EXECUTIONS));
    let mut read = 0u64;
    for seed in first..first + executions {
        let mut random = Random(seed);
        let mut bytes = mutated(&mut random, &target.samples);
        if random.coin() {
            (target.reseal)(&mut bytes);
        }
        let started = Instant::now();
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
            // The machine may have been busy; a decoder that hangs does so again.
            let started = Instant::now();
            decode(&bytes);
            took = started.elapsed();
        }
        assert!(took < LONGEST, "{case} takes {took:?}");
        let allowed = (target.bytes_max)(bytes.len());
        assert!(peak <= allowed, "{case} allocates {peak} bytes for {}, of {allowed} allowed", bytes.len());
    }
    println!("{}: {executions} executions from seed {first}, {read} were accepted", target.name);
}
