//! Tests that cannot run on this machine say so, and `.ci/run` counts them.

use std::env::var_os;
use std::fmt::Display;
use std::fs::File;
use std::io::Write;

/// Reports that the running test is skipped because of `reason`. Appends the line to the file that
/// `SKIPPED_TESTS` names too, since cargo hides what a passing test prints.
///
/// Panics if the environment has `requirement`, for example `REQUIRE_GPU`: then a skip is a failure.
pub fn skip(requirement: &str, reason: impl Display) {
    assert!(var_os(requirement).is_none(), "{requirement} is set, but {reason}");
    let thread = std::thread::current();
    let line = format!("SKIPPED {}: {reason}\n", thread.name().unwrap_or("a test"));
    print!("{line}");
    let Some(path) = var_os("SKIPPED_TESTS") else { return };
    // One write, so that lines of tests that run at once do not mix.
    let written = File::options()
        .create(true)
        .append(true)
        .open(&path)
        .and_then(|mut file| file.write_all(line.as_bytes()));
    written.unwrap_or_else(|error| panic!("{}: {error}", path.display()));
}
