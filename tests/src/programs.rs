//! The paths of the programs that cargo has built.

use std::env::{consts::EXE_EXTENSION, current_exe};
use std::path::{Path, PathBuf};

/// The path of a program that was built with the same profile as the running test or bench.
///
/// Panics if the program is missing: for a test, cargo does not build programs of other packages.
pub fn program(name: &str) -> PathBuf {
    let executable = current_exe().unwrap();
    // A test or bench lies in `deps`, one folder below the programs. A program of this package lies beside the
    // others.
    let folders = executable.ancestors().skip(1).take(2);
    let candidates: Vec<PathBuf> =
        folders.map(|folder: &Path| folder.join(name).with_extension(EXE_EXTENSION)).collect();
    let found = candidates.iter().find(|path| path.is_file());
    found.unwrap_or_else(|| panic!("{name} is missing: `cargo build --release` builds it")).clone()
}
