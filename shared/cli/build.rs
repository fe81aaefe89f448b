//! Writes the version with the commit that the programs are built from into the variable `COSURF_VERSION`.
//!
//! The commit is that of the environment variable `COSURF_COMMIT` if it is set, also to nothing; else that of a
//! package of crates.io; else that of the git repository of the workspace; else it is left out.

use std::env;
use std::fs;
use std::path::Path;
use std::process::Command;

/// Hexadecimal digits of a commit that are shown.
const DIGITS: usize = 10;

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-env-changed=COSURF_COMMIT");
    let commit = env::var("COSURF_COMMIT").ok().or_else(commit_of_package).or_else(commit_of_git);
    let version = env!("CARGO_PKG_VERSION");
    let shown = match commit.as_deref().map(str::trim).filter(|commit| is_commit(commit)) {
        Some(commit) => format!("{version} ({})", &commit[..DIGITS.min(commit.len())]),
        None => version.to_owned(),
    };
    println!("cargo::rustc-env=COSURF_VERSION={shown}");
}

fn is_commit(text: &str) -> bool {
    text.len() >= 7 && text.bytes().all(|byte| byte.is_ascii_hexdigit())
}

/// The commit that `cargo package` notes, as `"sha1": "..."`.
fn commit_of_package() -> Option<String> {
    let text = fs::read_to_string(".cargo_vcs_info.json").ok()?;
    let (_, rest) = text.split_once("\"sha1\"")?;
    rest.split('"').nth(1).map(str::to_owned)
}

/// The commit of the workspace's repository. A repository that only contains an unpacked package does not count.
fn commit_of_git() -> Option<String> {
    let root = Path::new("../..");
    if !root.join(".git").exists() {
        return None;
    }
    // Git appends a line to this file at each commit and checkout.
    let log = git(&["rev-parse", "--git-path", "logs/HEAD"])?;
    if Path::new(&log).exists() {
        println!("cargo::rerun-if-changed={log}");
    }
    git(&["rev-parse", "HEAD"])
}

fn git(arguments: &[&str]) -> Option<String> {
    let output =
        Command::new("git").args(arguments).output().ok().filter(|output| output.status.success())?;
    String::from_utf8(output.stdout).ok().map(|text| text.trim().to_owned())
}
