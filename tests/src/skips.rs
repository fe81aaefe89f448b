//! Tests that cannot run on this machine report that they were skipped, and `.ci/run` counts the reports.

use std::env::var_os;
use std::fmt::Display;
use std::fs::File;
use std::io::Write;

/// Reports that the running test is skipped because of `reason`. Prints a line, and appends it to the file that the
/// environment variable `SKIPPED_TESTS` names, if any: cargo hides what a passing test prints.
///
/// Panics if the environment variable named by `requirement`, for example `REQUIRE_GPU`, is set: a skip is then a
/// failure.
pub fn skip(requirement: &str, reason: impl Display) {
    assert!(var_os(requirement).is_none(), "{requirement} is set, but {reason}");
    let thread = std::thread::current();
    let line = format!("SKIPPED {}: {reason}\n", thread.name().unwrap_or("a test"));
    print!("{line}");
    let Some(path) = var_os("SKIPPED_TESTS") else { return };
    // A single write, so that the lines of tests that run in parallel do not mix.
    let written = File::options()
        .create(true)
        .append(true)
        .open(&path)
        .and_then(|mut file| file.write_all(line.as_bytes()));
    written.unwrap_or_else(|error| panic!("{}: {error}", path.display()));
}
