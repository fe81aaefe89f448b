//! The programs for Windows under Wine: a mission and a service with their pages, limits on memory, locks of folders, Ctrl-C, and
//! the same bytes as those of the programs for this system.
#![cfg(target_os = "linux")]
#![allow(clippy::unwrap_used)]

use std::collections::BTreeMap;
use std::fs;
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use cosurf_scene::bytes::parse_bytes;
use cosurf_tests::programs::program;
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
/// What a program ends with under `script` if Wine itself crashes. If a thread is just ending when the program ends, Wine 8 stops
/// that thread by a signal, whose handler needs what the thread has already given back: seen in the memory of a crash, once in a
/// hundred ends of a service.
const CRASH_OF_WINE: i32 = 128 + 11;
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
    the_same_mission_on_this_system_has_the_same_bytes(&wine);
    agents_end_with_a_mission_that_is_killed(&wine);
    ctrl_c_ends_a_training_with_a_checkpoint(&wine);
    a_service_shows_the_model_of_an_agent_and_ends_with_ctrl_c(&wine);
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

/// Compares both agents' models, and the model that was merged from them.
fn the_same_mission_on_this_system_has_the_same_bytes(wine: &Wine) {
    let mut mission = Command::new(program(AGGREGATOR));
    let mission = mission.args(MISSION).args(["--out", "here"]).current_dir(wine.folder()).output().unwrap();
    assert!(mission.status.success(), "{}", String::from_utf8_lossy(&mission.stderr));
    for file in ["agents/agent-1/model.ply", "agents/agent-2/model.ply", "global.ply"] {
        let [there, here] = ["out", "here"].map(|out| fs::read(wine.folder().join(out).join(file)).unwrap());
        assert!(there == here, "{file}: {} bytes there, {} here", there.len(), here.len());
    }
}

fn agents_end_with_a_mission_that_is_killed(wine: &Wine) {
    let steps = ["mission", "--data", "data", "--agents", "2", "--steps", "100000", "--memory", MEMORY];
    let mut mission = wine.command(AGGREGATOR, &[&steps[..], &["--out", "killed"]].concat());
    let mut mission = mission.spawn().unwrap();
    let begun = Instant::now();
    let agents = || wine.processes("cosurf-agent.exe").len();
    // A process that Wine is still creating when its parent is killed never begins, and never ends.
    let has_begun = |agent| wine.folder().join(format!("killed/agents/agent-{agent}/session")).is_file();
    while agents() < 2 || !(1..=2).all(has_begun) {
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
    press_ctrl_c(&mut training);
    assert!(wine.folder().join("stopped/checkpoint/state.bin").is_file());
}

/// Presses Ctrl-C, as a terminal sends it, and waits for the end of the program. Returns how it ended.
fn press_ctrl_c(program: &mut Child) -> ExitStatus {
    let begun = Instant::now();
    program.stdin.as_mut().unwrap().write_all(b"\x03").unwrap();
    loop {
        if let Some(status) = program.try_wait().unwrap() {
            return status;
        }
        assert!(begun.elapsed() < PATIENCE, "Ctrl-C does not end the program");
        sleep(LOOK_EVERY);
    }
}

/// Starts the ground station in a terminal, and waits for its page.
fn service_with_page(wine: &Wine, address: &str) -> Child {
    let mut service = wine.type_to(AGGREGATOR, &format!("run --config aggregator.toml --http {address}"));
    let begun = Instant::now();
    while get(address, "/healthz").is_none() {
        let log = fs::read_to_string(wine.folder().join("typed.log")).unwrap_or_default();
        assert!(begun.elapsed() < PATIENCE && service.try_wait().unwrap().is_none(), "no page: {log}");
        sleep(LOOK_EVERY);
    }
    service
}

/// A ground station with its built-in broker and its page, and a drone that sends a model.
fn a_service_shows_the_model_of_an_agent_and_ends_with_ctrl_c(wine: &Wine) {
    // Both are bound before one is free again.
    let free = [(); 2].map(|()| TcpListener::bind("127.0.0.1:0").unwrap());
    let [broker, address] = free.map(|listener| listener.local_addr().unwrap().to_string());
    let write = |name: &str, text: String| fs::write(wine.folder().join(name), text).unwrap();
    write(
        "aggregator.toml",
        format!(
            "site = \"site\"\nout = \"service\"\nbind = \"{broker}\"\nquorum = 1\nquiet_s = 0\nrefine = false\n"
        ),
    );
    write(
        "agent.toml",
        format!(
            "device = \"drone-1\"\nsite = \"site\"\nbroker = \"mqtt://{broker}\"\ndata = \"data\"\nout = \"drone\"\n\
             steps = 60\nwait_global = true\n"
        ),
    );
    let log = || fs::read_to_string(wine.folder().join("typed.log")).unwrap_or_default();
    let mut service = service_with_page(wine, &address);
    let mut agent = wine.command(AGENT, &["run", "--config", "agent.toml"]);
    let agent = agent.stderr(Stdio::piped()).output().unwrap();
    assert!(agent.status.success(), "{}", String::from_utf8_lossy(&agent.stderr));
    assert!(wine.folder().join("drone/global.ply").is_file(), "the merged model has arrived at the drone");
    let page = get(&address, "/").unwrap();
    assert!(page.contains("data-revision=\"1\""), "{page}");
    let state = get(&address, "/api/state").unwrap();
    assert!(
        state.contains("\"device\":\"drone-1\"") && state.contains("the model of drone-1 arrived"),
        "{state}"
    );
    let scene = get(&address, "/scene.json").unwrap();
    assert!(scene.starts_with("HTTP/1.1 200") && scene.contains("\"splats\":"), "{scene}");
    let mut ended = press_ctrl_c(&mut service);
    if ended.code() == Some(CRASH_OF_WINE) {
        println!("Wine has crashed; the service is started and ended once more");
        ended = press_ctrl_c(&mut service_with_page(wine, &address));
    }
    assert!(ended.success(), "{}", log());
    assert!(get(&address, "/healthz").is_none(), "the page has ended");
    assert!(wine.processes("cosurf-aggregator.exe").is_empty());
    assert!(wine.folder().join("service/merged.json").is_file(), "{}", log());
}
