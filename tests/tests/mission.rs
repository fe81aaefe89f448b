//! Whole missions, with the programs as they are flown: broker, agents, aggregator.
#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use cosurf_scene::city::{City, CitySettings};

/// Patience with one mission; it takes seconds.
const TIME_LIMIT: Duration = Duration::from_secs(300);

/// Where cargo puts programs: beside the folder of this test.
fn program(name: &str) -> PathBuf {
    let test = std::env::current_exe().unwrap();
    let path =
        test.parent().unwrap().parent().unwrap().join(name).with_extension(std::env::consts::EXE_EXTENSION);
    assert!(path.is_file(), "{} is missing: `cargo build` with the same profile makes it", path.display());
    path
}

fn start(data: &Path, out: &Path) -> Child {
    let mut command = Command::new(program("cosurf-aggregator"));
    command.args(["mission", "--agents", "2", "--steps", "300", "--data"]).arg(data).arg("--out").arg(out);
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap()
}

/// Waits for the end and returns the global model's bytes.
fn finish(mission: Child, out: &Path) -> Vec<u8> {
    let output = mission.wait_with_output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    fs::read(out.join("global.ply")).unwrap()
}

/// The processes that any thread of a process has started.
#[cfg(target_os = "linux")]
fn children(process: u32) -> Vec<u32> {
    let threads = fs::read_dir(format!("/proc/{process}/task")).unwrap();
    let lists = threads.filter_map(|thread| fs::read_to_string(thread.ok()?.path().join("children")).ok());
    lists
        .flat_map(|list| list.split_whitespace().map(|id| id.parse().unwrap()).collect::<Vec<u32>>())
        .collect()
}

/// The process of an agent that has saved a checkpoint: it is in the middle of its training.
#[cfg(target_os = "linux")]
fn agent_in_training(mission: &Child, out: &Path) -> Option<u32> {
    let begun = Instant::now();
    while begun.elapsed() < TIME_LIMIT {
        let saved = |device: &str| out.join("agents").join(device).join("checkpoint/state.bin").is_file();
        if saved("agent-1") || saved("agent-2") {
            return children(mission.id()).first().copied();
        }
        sleep(Duration::from_millis(2));
    }
    None
}

#[cfg(target_os = "linux")]
#[test]
fn an_agent_killed_in_training_changes_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let (data, calm, wild) =
        (folder.path().join("data"), folder.path().join("calm"), folder.path().join("wild"));
    let settings = CitySettings { extent_m: 60.0, views: 16, size_px: [160, 120], ..CitySettings::default() };
    City::build(&settings).unwrap().write(&data, |_, _| ()).unwrap();

    let undisturbed = finish(start(&data, &calm), &calm);
    let mission = start(&data, &wild);
    let agent = agent_in_training(&mission, &wild).expect("an agent that trains");
    assert!(Command::new("kill").args(["-9", &agent.to_string()]).status().unwrap().success());
    assert!(finish(mission, &wild) == undisturbed, "the global models differ");

    let report: serde_json::Value =
        serde_json::from_slice(&fs::read(wild.join("report.json")).unwrap()).unwrap();
    let restarts =
        report["agents"].as_array().unwrap().iter().map(|agent| agent["restarts"].as_u64().unwrap());
    assert_eq!(restarts.sum::<u64>(), 1, "nobody was killed");
}
