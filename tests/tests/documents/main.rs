//! Checks the documents: links have targets, the options of commands exist, and tables show what was measured.
#![allow(clippy::unwrap_used)]

mod commands;
mod links;
mod text;

use cosurf_tests::results::document;

/// Largest number of lines of the README, so that it can be read in five minutes.
const README_LINES_MAX: usize = 150;

#[test]
fn tables_show_the_stored_results() {
    let faults = document::faults().unwrap();
    assert!(faults.is_empty(), "`results --check` says:\n{}", faults.join("\n"));
}

#[test]
fn the_readme_is_short() {
    let lines = text::read("README.md").lines().count();
    assert!(lines <= README_LINES_MAX, "{lines} lines");
}
