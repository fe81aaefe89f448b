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

#[test]
fn a_log_is_written_where_it_is_asked_for_and_a_wrong_filter_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let merge = |words: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cosurf-aggregator"));
        command.arg("merge").arg(folder.path()).args(words);
        String::from_utf8(command.output().unwrap().stderr).unwrap()
    };
    // The folder holds no model: the span of the gate opens, and the merge fails inside it.
    let (quiet, logged) = (merge(&[]), merge(&["--log", "info"]));
    assert!(!quiet.contains("time.busy") && quiet.lines().count() == 1, "{quiet}");
    assert!(logged.contains("gate{models=1}: cosurf_aggregator::gate: close time.busy="), "{logged}");
    assert!(logged.contains(&quiet), "{logged}");
    let wrong = merge(&["--log", "loud"]);
    assert!(
        wrong.starts_with("cosurf-aggregator: --log \"loud\": ") && wrong.lines().count() == 1,
        "{wrong}"
    );
}
