//! The aggregator's command line as scripts use it.
#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::Path;
use std::process::{Command, Output, Stdio};

use cosurf_link::{ModelStore, Offer};
use cosurf_tests::offers::offer;
use cosurf_wire::ModelKind;

/// Runs the aggregator in `folder`.
fn aggregator(folder: &Path, words: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cosurf-aggregator"));
    command.args(words).current_dir(folder).output().unwrap()
}

/// The error of a command, which must be one line.
fn refused(folder: &Path, words: &[&str]) -> String {
    let output = aggregator(folder, words);
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert!(!output.status.success() && stderr.lines().count() == 1, "{words:?}: {stderr}");
    stderr
}

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
    std::fs::write(folder.path().join("cameras.json"), "[]").unwrap();
    std::fs::write(folder.path().join("model.ply"), "no model").unwrap();
    let merge = |words: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cosurf-aggregator"));
        command.arg("merge").arg(folder.path()).args(words).current_dir(folder.path());
        String::from_utf8(command.output().unwrap().stderr).unwrap()
    };
    // The model of the folder is damaged: the span of the gate opens, and the merge fails inside it.
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

#[test]
fn only_a_device_with_a_model_or_an_announced_flight_can_be_forgotten() {
    let folder = tempfile::tempdir().unwrap();
    let site = folder.path();
    fs::write(site.join("aggregator.toml"), "site = \"s\"\nout = \"out\"\nbind = \"127.0.0.1:0\"\n").unwrap();
    let error = refused(site, &["forget", "drone-1"]);
    assert!(error.contains("drone-1") && error.contains("with a model: none"), "{error}");

    let (models, _) = ModelStore::open(&site.join("out/models")).unwrap();
    let Offer { header, body } = offer("drone-1", 1, ModelKind::Local, 1, 16, 1024);
    models.put(&header, &body).unwrap();
    let error = refused(site, &["forget", "drone-2"]);
    assert!(error.contains("no model of drone-2") && error.contains("with a model: drone-1."), "{error}");
    assert!(error.contains("--announced") && !site.join("out/withdrawn").exists(), "{error}");

    for words in [&["forget", "drone-1"][..], &["forget", "drone-2", "--announced"]] {
        assert!(aggregator(site, words).status.success(), "{words:?}");
        assert!(site.join("out/withdrawn").join(words[1]).is_file(), "{words:?}");
    }
}

#[test]
fn a_missing_configuration_file_and_a_wrong_setting_are_told_with_the_file() {
    let folder = tempfile::tempdir().unwrap();
    for words in [&["run"][..], &["forget", "drone-1"]] {
        let error = refused(folder.path(), words);
        assert!(
            error.contains("aggregator.toml: there is no such file") && error.contains("--config"),
            "{error}"
        );
    }
    for (settings, reason) in [
        ("", "write either bind"),
        ("bind = \"192.0.2.1:0\"", "bind: "),
        ("broker = \"mqtts://127.0.0.1:1\"", "tls: a broker at mqtts:// or wss:// needs"),
        (
            "broker = \"mqtts://127.0.0.1:1\"\ntls = { ca = \"no.pem\", cert = \"a\", key = \"b\" }",
            "tls: no.pem: ",
        ),
    ] {
        fs::write(folder.path().join("site.toml"), format!("site = \"s\"\nout = \"out\"\n{settings}\n"))
            .unwrap();
        let error = refused(folder.path(), &["run", "--config", "site.toml"]);
        assert!(error.starts_with(&format!("cosurf-aggregator: site.toml: {reason}")), "{error}");
    }
}
