//! The programs for Windows under Wine: a mission with its page, limits on memory, locks of folders, and Ctrl-C.
#![cfg(target_os = "linux")]
#![allow(clippy::unwrap_used)]

use std::collections::BTreeMap;
use std::fs;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::process::Stdio;
use std::thread::sleep;
use std::time::{Duration, Instant};

use cosurf_scene::bytes::parse_bytes;
use cosurf_tests::usage::peak_bytes;
use cosurf_tests::wine::Wine;
use serde_json::Value;

/// Time after which a test gives a program up.
const PATIENCE: Duration = Duration::from_secs(300);
const LOOK_EVERY: Duration = Duration::from_millis(50);
const AGENT: &str = "cosurf-agent";
const AGGREGATOR: &str = "cosurf-aggregator";
/// Memory of each agent. Wine itself takes 45 MiB of it: it reads programs whole.
const MEMORY: &str = "100MiB";
const MISSION: [&str; 9] =
    ["mission", "--data", "data", "--agents", "2", "--steps", "60", "--memory", MEMORY];

#[test]
fn programs_for_windows_work() {
    let Some(wine) = Wine::start() else { return };
    let town = wine.run(AGGREGATOR, &["town", "data", "--size", "96", "--views", "48"]);
    assert!(town.status.success(), "{}", String::from_utf8_lossy(&town.stderr));
    assert!(wine.run(AGENT, &["doctor"]).status.success());
    little_memory_is_refused(&wine);
    a_mission_flies_and_shows_its_page(&wine);
    agents_end_with_a_mission_that_is_killed(&wine);
    ctrl_c_ends_a_training_with_a_checkpoint(&wine);
}

fn little_memory_is_refused(wine: &Wine) {
    let mut train = wine.command(AGENT, &["train", "data", "--out", "none", "--memory", "4MiB"]);
    let refused = train.stderr(Stdio::piped()).output().unwrap();
    let told = String::from_utf8_lossy(&refused.stderr);
    assert!(!refused.status.success() && told.contains("it needs at least"), "{told}");
}

fn a_mission_flies_and_shows_its_page(wine: &Wine) {
    let log = wine.folder().join("mission.log");
    let file = fs::File::create(&log).unwrap();
    let mut mission =
        wine.command(AGGREGATOR, &[&MISSION[..], &["--out", "out", "--http", "127.0.0.1:0"]].concat());
    let mut mission = mission.stderr(file).spawn().unwrap();
    let begun = Instant::now();
    let (mut peaks, mut is_shown, mut is_locked) = (BTreeMap::new(), false, false);
    let status = loop {
        for agent in wine.processes("cosurf-agent.exe") {
            peaks.extend(peak_bytes(agent).map(|bytes| (agent, bytes)));
        }
        let text = fs::read_to_string(&log).unwrap();
        if let Some(address) =
            text.lines().find_map(|line| line.strip_prefix("http://")).filter(|_| !is_shown)
        {
            let address = address.split('/').next().unwrap();
            is_shown = get(address, "/").is_some_and(|page| page.contains("cosurf ground station"))
                && get(address, "/api/state").is_some_and(|state| state.contains("\"device\":\"agent-2\""));
        } else if is_shown && !is_locked {
            let mut second = wine.command(AGGREGATOR, &[&MISSION[..], &["--out", "out"]].concat());
            let second = second.stderr(Stdio::piped()).output().unwrap();
            is_locked = !second.status.success();
            assert!(is_locked, "two missions in one folder");
        }
        if let Some(status) = mission.try_wait().unwrap() {
            break status;
        }
        assert!(begun.elapsed() < PATIENCE, "{text}");
        sleep(LOOK_EVERY);
    };
    let text = fs::read_to_string(&log).unwrap();
    assert!(status.success() && is_shown && is_locked, "page: {is_shown}, lock: {is_locked}: {text}");
    let report: Value =
        serde_json::from_slice(&fs::read(wine.folder().join("out/report.json")).unwrap()).unwrap();
    let told = |agent: usize| report["agents"][agent]["training"]["peak_memory_bytes"].as_u64().unwrap();
    let (told, seen) = (told(0).max(told(1)), peaks.values().copied().max().unwrap_or(0));
    println!("agents: {told} bytes told, {seen} seen");
    assert!(told.max(seen) <= parse_bytes(MEMORY).unwrap(), "{told} told, {seen} seen");
    assert!(told as f64 > 0.9 * seen as f64 && seen as f64 > 0.9 * told as f64, "{told} told, {seen} seen");
    // Over the files that are there.
    let again = wine.run(AGGREGATOR, &[&MISSION[..], &["--out", "out"]].concat());
    assert!(again.status.success(), "a mission that has ended cannot be repeated");
}

fn agents_end_with_a_mission_that_is_killed(wine: &Wine) {
    let steps = ["mission", "--data", "data", "--agents", "2", "--steps", "100000", "--memory", MEMORY];
    let mut mission = wine.command(AGGREGATOR, &[&steps[..], &["--out", "killed"]].concat());
    let mut mission = mission.spawn().unwrap();
    let begun = Instant::now();
    let agents = || wine.processes("cosurf-agent.exe").len();
    while agents() < 2 {
        assert!(begun.elapsed() < PATIENCE && mission.try_wait().unwrap().is_none(), "no agents begin");
        sleep(LOOK_EVERY);
    }
    mission.kill().unwrap();
    mission.wait().unwrap();
    while agents() > 0 {
        assert!(begun.elapsed() < PATIENCE, "agents outlive their mission");
        sleep(LOOK_EVERY);
    }
}

/// The answer to a request; `None` if there is none yet.
fn get(address: &str, path: &str) -> Option<String> {
    let mut stream = TcpStream::connect(address).ok()?;
    stream.set_read_timeout(Some(Duration::from_secs(10))).ok()?;
    stream.write_all(format!("GET {path} HTTP/1.1\r\nHost: {address}\r\n\r\n").as_bytes()).ok()?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer).ok()?;
    Some(answer)
}

fn ctrl_c_ends_a_training_with_a_checkpoint(wine: &Wine) {
    let mut training = wine.type_to(AGENT, "train data --out stopped --steps 100000 --memory 100MiB");
    let begun = Instant::now();
    let is_training =
        || fs::read_to_string(wine.folder().join("typed.log")).is_ok_and(|text| text.contains("/100000"));
    while !is_training() {
        assert!(begun.elapsed() < PATIENCE, "the training does not begin");
        sleep(LOOK_EVERY);
    }
    // Ctrl-C, as a terminal sends it.
    training.stdin.as_mut().unwrap().write_all(b"\x03").unwrap();
    while training.try_wait().unwrap().is_none() {
        assert!(begun.elapsed() < PATIENCE, "Ctrl-C does not end the training");
        sleep(LOOK_EVERY);
    }
    assert!(wine.folder().join("stopped/checkpoint/state.bin").is_file());
}
