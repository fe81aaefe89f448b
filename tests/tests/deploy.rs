//! Checks the files of `shared/deploy`: against the schemas of Compose and Kubernetes, and against our programs.
#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use cosurf_aggregator::service::{AggregatorConfig, MemoryBound};
use cosurf_scene::bytes::parse_bytes;
use cosurf_tests::programs::program;
use cosurf_tests::skips::skip;

/// A program may take this share of its container's memory. The rest is for the system's buffers.
const SHARE_MAX: f64 = 0.875;
const MIB: u64 = 1 << 20;

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/deploy")
}

fn read(name: &str) -> String {
    fs::read_to_string(folder().join(name)).unwrap()
}

/// Whether the validator accepts the file; `None` if the validator is not installed.
fn is_valid(validator: &[&str], file: &Path) -> Option<bool> {
    let output = Command::new(validator[0]).args(&validator[1..]).arg(file).output().ok()?;
    print!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    Some(output.status.success())
}

/// Checks that the validator accepts a file, and refuses it with `right` replaced by `wrong`.
fn check(validator: &[&str], name: &str, right: &str, wrong: &str) {
    let Some(accepts) = is_valid(validator, &folder().join(name)) else {
        skip("REQUIRE_VALIDATORS", format_args!("{} is not installed", validator[0]));
        return;
    };
    assert!(accepts, "{name} is not valid");
    let broken = tempfile::tempdir().unwrap();
    let (broken, text) = (broken.path().join(name), read(name));
    assert!(text.contains(right));
    fs::write(&broken, text.replace(right, wrong)).unwrap();
    assert_eq!(is_valid(validator, &broken), Some(false), "{wrong} is accepted");
}

#[test]
fn compose_accepts_its_file() {
    let validator = ["check-jsonschema", "--builtin-schema", "vendor.compose-spec"];
    check(&validator, "compose.yaml", "mem_limit:", "mem_limits:");
    check(&validator, "compose.yaml", "depends_on: [store]", "depends_on: store");
}

#[test]
fn kubernetes_accepts_its_file() {
    let validator = ["kubernetes-validate", "--strict"];
    check(&validator, "kubernetes.yaml", "strategy: { type:", "strategy: { kind:");
    check(&validator, "kubernetes.yaml", "replicas: 1", "replicas: one");
}

#[test]
fn hadolint_accepts_the_image_file() {
    check(&["hadolint"], "Dockerfile", "WORKDIR /cosurf", "WORKDIR cosurf");
}

/// The commands of our programs in a file. They are written as arrays of JSON, which YAML allows.
fn commands(text: &str) -> Vec<Vec<String>> {
    let arrays = text.lines().filter_map(|line| line.trim().strip_prefix("command: "));
    let commands = arrays.map(|array| serde_json::from_str::<Vec<String>>(array).unwrap());
    commands.filter(|command| command[0].starts_with("cosurf-")).collect()
}

/// Whether a program understands a command's options.
fn is_understood(command: &[String]) -> bool {
    let output = Command::new(program(&command[0])).args(&command[1..]).arg("--help").output().unwrap();
    output.status.success()
}

/// The value of an option.
fn option<'a>(command: &'a [String], name: &str) -> Option<&'a str> {
    command.iter().skip_while(|word| *word != name).nth(1).map(String::as_str)
}

/// The limits on the memory of the containers with our programs, bytes, in the order of the commands.
fn limits(text: &str) -> Vec<u64> {
    let ours = text.split("\"cosurf-aggregator\",").skip(1);
    let limit = |part: &str| {
        let at = ["mem_limit: ", "limits: { memory: "].iter().find_map(|key| part.split_once(key)).unwrap().1;
        let mib: String = at.chars().take_while(char::is_ascii_digit).collect();
        let unit = &at[mib.len()..];
        assert!(unit.starts_with("m\n") || unit.starts_with("Mi "), "{unit}");
        mib.parse::<u64>().unwrap() * MIB
    };
    ours.map(limit).collect()
}

fn fits(bytes: u64, limit: u64) -> bool {
    bytes as f64 <= SHARE_MAX * limit as f64
}

#[test]
fn programs_understand_their_commands_and_fit_into_their_containers() {
    let config = AggregatorConfig::read(&folder().join("aggregator.toml")).unwrap();
    let workers = config.workers.as_ref().unwrap();
    for name in ["compose.yaml", "kubernetes.yaml"] {
        let text = read(name);
        let (commands, limits) = (commands(&text), limits(&text));
        assert_eq!((commands.len(), limits.len()), (2, 2), "{name}");
        let [station, worker] = &commands[..] else { unreachable!() };
        assert!(is_understood(station) && is_understood(worker), "{name}");
        assert_eq!(option(station, "--config"), Some("/etc/cosurf/aggregator.toml"), "{name}");
        assert!(fits(MemoryBound::of(&config).at_most_bytes(), limits[0]), "{name}");
        let memory = parse_bytes(option(worker, "--memory").unwrap()).unwrap();
        assert!(fits(memory, limits[1]), "{name}: {memory} of {} bytes", limits[1]);
        assert_eq!(option(worker, "--queue"), Some(workers.queue.as_str()), "{name}");
        assert_eq!(option(worker, "--tiles"), Some(workers.tiles.as_str()), "{name}");
        let users = config.users.as_ref().unwrap().parent().unwrap();
        assert!(text.contains(users.to_str().unwrap()), "{name}: the users are in a volume");
        assert!(text.contains(config.out.to_str().unwrap()), "{name}: the site's folder is a volume");
    }
    let wrong = ["cosurf-aggregator", "worker", "--memori", "1GiB"].map(String::from);
    assert!(!is_understood(&wrong) && !fits(7 * MIB + 1, 8 * MIB), "the checks can fail");
}

#[test]
fn kubernetes_gets_the_configuration_that_compose_gets() {
    let (config, text) = (read("aggregator.toml"), read("kubernetes.yaml"));
    let (_, rest) = text.split_once("  aggregator.toml: |\n").unwrap();
    let (block, _) = rest.split_once("---\n").unwrap();
    let block: Vec<&str> = block.lines().map(|line| line.strip_prefix("    ").unwrap_or(line)).collect();
    assert_eq!(block, config.lines().collect::<Vec<_>>());
}
