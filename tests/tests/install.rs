//! Checks what an installation has beside the programs: completions, manual pages, units of systemd, and `doctor`.
#![allow(clippy::unwrap_used)]

use std::fs;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use cosurf_aggregator::service::AggregatorConfig;
use cosurf_contract::AgentConfig;
use cosurf_tests::programs::program;
use cosurf_tests::skips::skip;
use serde_json::Value;

const PROGRAMS: [&str; 2] = ["cosurf-agent", "cosurf-aggregator"];

fn deploy(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/deploy").join(path)
}

fn run(name: &str, arguments: &[&str]) -> Output {
    Command::new(program(name)).args(arguments).output().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Runs a program that checks files; `None` if it is not installed.
fn checked_by(checker: &[&str], file: &Path) -> Option<Output> {
    Command::new(checker[0]).args(&checker[1..]).arg(file).output().ok()
}

/// The commands of a program, as its help lists them.
fn commands(name: &str) -> Vec<String> {
    let help = text(&run(name, &["--help"]).stdout);
    let (_, list) = help.split_once("Commands:\n").unwrap();
    let lines = list.lines().take_while(|line| !line.is_empty());
    let names = lines.filter(|line| line.starts_with("  ") && !line.starts_with("   "));
    names.map(|line| line.split_whitespace().next().unwrap().to_owned()).collect()
}

#[test]
fn versions_name_the_commit() {
    for name in PROGRAMS {
        let version = text(&run(name, &["--version"]).stdout);
        let rest = version.trim_end().strip_prefix(&format!("{name} {}", env!("CARGO_PKG_VERSION"))).unwrap();
        let commit = rest.strip_prefix(" (").and_then(|rest| rest.strip_suffix(')'));
        let is_commit = commit.is_some_and(|commit| commit.bytes().all(|byte| byte.is_ascii_hexdigit()));
        assert!(rest.is_empty() || is_commit, "{version}");
    }
}

#[test]
fn every_example_in_a_help_text_is_understood() {
    let mut count = 0;
    for name in PROGRAMS {
        for command in commands(name) {
            let help = text(&run(name, &[&command, "--help"]).stdout);
            let examples = help.lines().filter_map(|line| line.trim().strip_prefix(name));
            for example in examples.filter(|line| line.starts_with(' ')) {
                let command = example.split([' ']).take_while(|word| !["<", ">", ">>"].contains(word));
                let words: Vec<&str> = command.filter(|word| !word.is_empty()).chain(["--help"]).collect();
                assert!(run(name, &words).status.success(), "{name}{example}");
                count += 1;
            }
        }
        assert!(!run(name, &["key", "--no-such-option", "--help"]).status.success());
    }
    assert!(count > 20, "{count}");
}

#[test]
fn shells_accept_the_completions() {
    let folder = tempfile::tempdir().unwrap();
    for name in PROGRAMS {
        let script = run(name, &["completions", "bash"]);
        let path = folder.path().join(name);
        fs::write(&path, &script.stdout).unwrap();
        assert!(script.status.success() && text(&script.stdout).contains("doctor"));
        match checked_by(&["bash", "-n"], &path) {
            Some(output) => assert!(output.status.success(), "{}", text(&output.stderr)),
            None => skip("REQUIRE_PACKAGING", "bash is not installed"),
        }
    }
}

#[test]
fn manual_pages_have_no_errors() {
    let folder = tempfile::tempdir().unwrap();
    for name in PROGRAMS {
        assert!(run(name, &["man", folder.path().to_str().unwrap()]).status.success());
        for command in commands(name).iter().filter(|command| *command != "help") {
            assert!(folder.path().join(format!("{name}-{command}.1")).is_file(), "{command}");
        }
    }
    let page = folder.path().join("cosurf-agent-train.1");
    let Some(output) = checked_by(&["mandoc", "-Tlint", "-Werror"], &page) else {
        skip("REQUIRE_PACKAGING", "mandoc is not installed");
        return;
    };
    assert!(output.status.success(), "{}", text(&output.stdout));
    for page in fs::read_dir(folder.path()).unwrap() {
        let output = checked_by(&["mandoc", "-Tlint", "-Werror"], &page.unwrap().path()).unwrap();
        assert!(output.status.success(), "{}", text(&output.stdout));
    }
}

/// A unit with the program that cargo has built in place of the installed one.
fn unit(name: &str, folder: &Path) -> PathBuf {
    let unit = fs::read_to_string(deploy(&format!("systemd/{name}.service"))).unwrap();
    let built = unit.replace(&format!("/usr/bin/{name}"), program(name).to_str().unwrap());
    assert_ne!(built, unit);
    let path = folder.join(format!("{name}.service"));
    fs::write(&path, built).unwrap();
    path
}

#[test]
fn systemd_accepts_the_units_and_finds_them_guarded() {
    let folder = tempfile::tempdir().unwrap();
    for name in PROGRAMS {
        let unit = unit(name, folder.path());
        let Some(verified) = checked_by(&["systemd-analyze", "verify", "--man=no"], &unit) else {
            skip("REQUIRE_PACKAGING", "systemd-analyze is not installed");
            return;
        };
        let complaints = text(&verified.stderr);
        assert!(verified.status.success() && !complaints.contains(name), "{complaints}");
        // Below 3 of 10, in tenths.
        let security = ["systemd-analyze", "security", "--offline=true", "--threshold=29"];
        let output = checked_by(&security, &unit).unwrap();
        assert!(output.status.success(), "{}", text(&output.stdout));
        let open = fs::read_to_string(&unit).unwrap().replace("ProtectSystem=strict", "ProtectSystme=strict");
        fs::write(&unit, open).unwrap();
        let output = checked_by(&["systemd-analyze", "verify", "--man=no"], &unit).unwrap();
        assert!(text(&output.stderr).contains("ProtectSystme"), "the check can fail");
    }
}

#[test]
fn units_and_example_configurations_fit_together() {
    let agent = AgentConfig::from_toml(&fs::read_to_string(deploy("debian/agent.toml")).unwrap()).unwrap();
    let aggregator = AggregatorConfig::read(&deploy("debian/aggregator.toml")).unwrap();
    assert_eq!(agent.site, aggregator.site);
    for (name, folders) in [(PROGRAMS[0], vec![agent.data, agent.out]), (PROGRAMS[1], vec![aggregator.out])] {
        let unit = fs::read_to_string(deploy(&format!("systemd/{name}.service"))).unwrap();
        let value = |key: &str| unit.lines().find_map(|line| line.strip_prefix(&format!("{key}="))).unwrap();
        let state = Path::new("/var/lib").join(value("StateDirectory"));
        assert!(folders.iter().all(|folder| folder.starts_with(&state)), "{folders:?} below {state:?}");
        let command: Vec<&str> = value("ExecStart").split_whitespace().skip(1).collect();
        let end = name.strip_prefix("cosurf-").unwrap();
        assert!(command.contains(&format!("/etc/cosurf/{end}.toml").as_str()), "{command:?}");
        assert!(run(name, &[&command[..], &["--help"]].concat()).status.success(), "{command:?}");
    }
}

#[test]
fn packages_have_the_files_that_their_metadata_name() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    for name in PROGRAMS {
        let folder = root.join(name.strip_prefix("cosurf-").unwrap());
        let manifest: toml::Table = fs::read_to_string(folder.join("Cargo.toml")).unwrap().parse().unwrap();
        let deb = &manifest["package"]["metadata"]["deb"];
        let assets = deb["assets"].as_array().unwrap();
        let sources = assets.iter().map(|asset| asset[0].as_str().unwrap()).chain(deb["changelog"].as_str());
        // The others are built.
        let kept: Vec<&str> = sources.filter(|source| !source.contains("target/")).collect();
        assert!(kept.len() > 4, "{kept:?}");
        assert!(kept.iter().all(|source| folder.join(source).is_file()), "{name}: {kept:?}");
        let targets = |end: &str| assets.iter().any(|asset| asset[1].as_str().unwrap().starts_with(end));
        for place in ["usr/bin/", "usr/share/man/man1/", "usr/share/bash-completion/", "usr/lib/sysusers.d/"]
        {
            assert!(targets(place), "{name}: {place}");
        }
        let units = deb["systemd-units"]["unit-scripts"].as_str().unwrap();
        assert!(folder.join(units).join(format!("{name}.service")).is_file());
        let config = deb["conf-files"][0].as_str().unwrap();
        let unit = fs::read_to_string(deploy(&format!("systemd/{name}.service"))).unwrap();
        assert!(unit.contains(config), "{config} is the file of the unit");
    }
}

/// Runs `doctor` in a folder with a configuration. Returns whether it succeeded, and its findings.
fn doctor(name: &str, folder: &Path, file: &str, config: &str) -> (bool, Vec<Value>) {
    fs::write(folder.join(file), config).unwrap();
    let output = Command::new(program(name)).args(["doctor", "--json"]).current_dir(folder).output().unwrap();
    let lines = text(&output.stdout).lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    (output.status.success(), lines)
}

/// The finding of a check.
fn finding<'a>(findings: &'a [Value], check: &str) -> &'a Value {
    findings.iter().find(|finding| finding["check"] == check).unwrap_or_else(|| panic!("{findings:?}"))
}

#[test]
fn doctor_tells_what_keeps_an_agent_from_working() {
    let folder = tempfile::tempdir().unwrap();
    let free = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let config =
        format!("device = \"drone-1\"\nsite = \"s\"\nbroker = \"mqtt://{free}\"\ncompute = \"cpu\"\n");
    let (is_well, findings) = doctor("cosurf-agent", folder.path(), "agent.toml", &config);
    let line = finding(&findings, "line");
    assert!(!is_well && line["state"] == "mend" && line["found"].to_string().contains("refused"), "{line}");
    assert_eq!(finding(&findings, "compute")["state"], "ok");
    assert_eq!(finding(&findings, "disk")["state"], "ok");
    let (is_well, findings) = doctor("cosurf-agent", folder.path(), "agent.toml", "site = 7\n");
    assert!(!is_well && finding(&findings, "config")["state"] == "mend");
    fs::remove_file(folder.path().join("agent.toml")).unwrap();
    let (is_well, findings) = doctor("cosurf-agent", folder.path(), "unused", "");
    assert!(is_well && finding(&findings, "config")["state"] == "note", "{findings:?}");
}

#[test]
fn doctor_tells_what_keeps_a_ground_station_from_working() {
    let folder = tempfile::tempdir().unwrap();
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap();
    let config = format!("site = \"s\"\nout = \"out\"\nbind = \"{address}\"\nmerge_memory = \"100MiB\"\n");
    let (is_well, findings) = doctor("cosurf-aggregator", folder.path(), "aggregator.toml", &config);
    let port = finding(&findings, "port");
    assert!(!is_well && port["state"] == "mend" && port["remedy"].to_string().contains("bind"), "{port}");
    drop(taken);
    let (is_well, findings) = doctor("cosurf-aggregator", folder.path(), "aggregator.toml", &config);
    assert!(is_well && finding(&findings, "port")["state"] == "ok", "{findings:?}");
    assert!(!folder.path().join("out").exists(), "it has made the folder");
}
