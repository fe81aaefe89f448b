//! The aggregator's command line as scripts use it.
#![allow(clippy::unwrap_used)]

use std::process::{Command, Stdio};

#[test]
fn a_closed_pipe_ends_a_command_without_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let key = folder.path().join("key");
    let mut command = Command::new(env!("CARGO_BIN_EXE_cosurf-aggregator"));
    command.arg("key").arg(&key).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && stderr.is_empty() && key.is_file(), "{stderr}");
}
