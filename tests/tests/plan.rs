//! The plan of a site reaches the drones by the real programs: each agent trains on the pictures of its own cell.
#![cfg(unix)]
#![allow(clippy::unwrap_used)]

use std::fs;
use std::io::Write;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::thread::sleep;
use std::time::{Duration, Instant};

use cosurf_agent::cell::split_by_cell;
use cosurf_agent::session::Split;
use cosurf_contract::{AgentConfig, AgentEvent, ChosenBy};
use cosurf_link::PlannedCell;
use cosurf_scene::{Dataset, Ground, footprints};
use cosurf_tests::datasets::write_city;
use cosurf_tests::running::{PATIENCE, Running};
use cosurf_wire::VerticalAxis;
use tempfile::TempDir;

const DRONES: [&str; 2] = ["drone-1", "drone-2"];
const MARGIN: f64 = 0.1;

/// Pictures of a small city, made once.
fn data() -> &'static Path {
    static DATA: OnceLock<TempDir> = OnceLock::new();
    DATA.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        write_city(folder.path(), 60.0, 24, [96, 72]);
        folder
    })
    .path()
}

/// A western and an eastern cell, which contain the centres of all footprints.
fn cells() -> [Vec<[f64; 2]>; 2] {
    let dataset = Dataset::open(data()).unwrap();
    let centers = footprints(&dataset, &Ground::of(&dataset)).into_iter().map(|print| print.center);
    let centers: Vec<_> = centers.collect();
    let bound = |axis: usize| {
        let along = centers.iter().map(|center| center[axis]);
        [along.clone().fold(f64::MAX, f64::min) - 1.0, along.fold(f64::MIN, f64::max) + 1.0]
    };
    let ([west, east], [south, north]) = (bound(0), bound(1));
    let cell = |[west, east]: [f64; 2]| vec![[west, south], [east, south], [east, north], [west, north]];
    let middle = (west + east) / 2.0;
    [cell([west, middle]), cell([middle, east])]
}

/// The cells as GeoJSON, each for a drone.
fn geojson() -> String {
    let feature = |(device, cell): (&&str, Vec<[f64; 2]>)| {
        serde_json::json!({
            "type": "Feature",
            "properties": { "device": device },
            "geometry": { "type": "Polygon", "coordinates": [cell] },
        })
    };
    let features: Vec<_> = DRONES.iter().zip(cells()).map(feature).collect();
    serde_json::json!({ "type": "FeatureCollection", "features": features }).to_string()
}

/// The aggregator of a site with the plan, and the address of its broker.
fn ground(folder: &Path, more: &str) -> (Running, String) {
    let address = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    fs::write(folder.join("cells.geojson"), geojson()).unwrap();
    let text = format!(
        "site = \"site\"\nout = \"ground\"\nbind = \"{address}\"\nquorum = 2\nquiet_s = 0\n\
         plan = \"cells.geojson\"\nmargin = {MARGIN}\n{more}"
    );
    fs::write(folder.join("aggregator.toml"), text).unwrap();
    (Running::start("cosurf-aggregator", folder, &["run"]), format!("mqtt://{address}"))
}

/// The folder of a drone with its `agent.toml`.
fn drone(folder: &Path, device: &str, broker: &str, more: &str) -> PathBuf {
    let folder = folder.join(device);
    fs::create_dir_all(&folder).unwrap();
    let text = format!(
        "site = \"site\"\nbroker = \"{broker}\"\ndevice = \"{device}\"\ndata = \"{}\"\n{more}",
        data().display()
    );
    fs::write(folder.join("agent.toml"), text).unwrap();
    folder
}

/// Starts the agent of a drone.
fn agent(folder: &Path) -> Running {
    Running::start("cosurf-agent", folder, &["run", "--json"])
}

/// The choice that an agent has told: what it follows, how many pictures, and of how many.
fn choice(log: &str) -> (ChosenBy, usize, usize) {
    let events = log.lines().filter_map(|line| serde_json::from_str(line).ok());
    let choice = |event| match event {
        AgentEvent::ViewsChosen { by, pictures, of, .. } => Some((by, pictures, of)),
        _ => None,
    };
    events.filter_map(choice).next().unwrap_or_else(|| panic!("no choice: {log}"))
}

/// Views to train on and to hold out, as the agent chooses them.
fn views_of(cell: Vec<[f64; 2]>) -> [Vec<String>; 2] {
    let dataset = Dataset::open(data()).unwrap();
    let cell = PlannedCell { vertical: VerticalAxis::Z, corners: cell, margin: MARGIN };
    match split_by_cell(&dataset, &cell, 8).unwrap() {
        Split::Named { train, held_out } => [train, held_out],
        Split::Every(_) => panic!("all views"),
    }
}

/// `agent.toml` has only `site`, `broker`, `device` and `data`. So the agents would train for 3,000 steps, which is too
/// long for a test: they are killed after they have told their choice, and go on with fewer steps.
#[test]
fn each_agent_trains_on_its_own_cell_and_the_global_model_has_both() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let (station, broker) = ground(folder, "");
    let expected = cells().map(views_of);
    assert_ne!(expected[0], expected[1]);
    for (device, [train, held_out]) in DRONES.iter().zip(&expected) {
        let running = agent(&drone(folder, device, &broker, ""));
        let begun = Instant::now();
        while !running.log().contains("\"started\"") {
            assert!(begun.elapsed() < PATIENCE, "{}", running.log());
            sleep(Duration::from_millis(20));
        }
        let pictures = train.len() + held_out.len();
        assert_eq!(choice(&running.log()), (ChosenBy::Cell, pictures, 24));
    }
    let few = "steps = 30\nthreads = 1\nout = \"short\"\nwait_global = true\n";
    let agents = DRONES.map(|device| agent(&drone(folder, device, &broker, few)));
    for (running, [train, held_out]) in agents.into_iter().zip(&expected) {
        let out = running.log_path().with_file_name("short");
        let (ended_well, log) = running.end();
        assert!(ended_well, "{log}");
        let report: serde_json::Value =
            serde_json::from_slice(&fs::read(out.join("report.json")).unwrap()).unwrap();
        assert_eq!((&report["views"], &report["held_out"]), (&train.len().into(), &held_out.len().into()));
    }
    let log = station.log();
    assert!(log.contains("from 2 models"), "{log}");
    let global = DRONES.map(|device| fs::read(folder.join(device).join("short/global.ply")).unwrap());
    assert!(global[0] == global[1], "the agents have different global models");
}

/// The same cells by `mission --cells` give each agent the same views.
#[test]
fn a_cell_has_the_views_that_a_mission_gives_to_it() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::write(folder.join("cells.geojson"), geojson()).unwrap();
    let (data, margin) = (data().display().to_string(), MARGIN.to_string());
    let mission = [
        &["mission", "--data", &data, "--cells", "cells.geojson", "--margin", &margin][..],
        &["--steps", "10", "--out", "out"],
    ];
    let running = Running::start("cosurf-aggregator", folder, &mission.concat());
    let config = |agent: usize| folder.join(format!("out/agents/agent-{agent}/agent.toml"));
    let begun = Instant::now();
    let configs = loop {
        let texts = [1, 2].map(|agent| fs::read_to_string(config(agent)));
        if let [Ok(first), Ok(second)] = texts {
            break [first, second];
        }
        assert!(begun.elapsed() < PATIENCE, "{}", running.log());
        sleep(Duration::from_millis(20));
    };
    drop(running);
    for (text, cell) in configs.iter().zip(cells()) {
        let config = AgentConfig::from_toml(text).unwrap();
        assert_eq!([config.views, config.held_out], views_of(cell));
    }
}

/// Runs an agent with these lines until it ends. Returns whether it ended well, and its log.
fn run(folder: &Path, broker: &str, device: &str, lines: &str) -> (bool, String) {
    let lines = format!("steps = 5\nthreads = 1\n{lines}");
    let out = folder.join(device).join("out");
    let _ = fs::remove_dir_all(&out);
    agent(&drone(folder, device, broker, &lines)).end()
}

#[test]
fn views_and_frame_of_the_configuration_meet_the_plan() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let (station, broker) = ground(folder, "frame = \"enu\"\n");
    let [train, _] = views_of(cells()[1].clone());
    let views = format!("views = {:?}\n", &train[..4]);
    let (ended_well, log) = run(folder, &broker, "drone-1", &views);
    assert!(ended_well, "{log}");
    assert_eq!(choice(&log), (ChosenBy::Configuration, 4, 24), "they win over the cell");
    assert!(
        station.log().contains("the model of drone-1 arrived"),
        "in the frame of the plan: {}",
        station.log()
    );
    let (ended_well, log) = run(folder, &broker, "drone-3", "");
    assert!(ended_well, "{log}");
    assert_eq!(choice(&log), (ChosenBy::NoCell, 24, 24));
    let (ended_well, log) = run(folder, &broker, "drone-2", "frame = \"utm\"\n");
    assert!(!ended_well && log.contains("utm") && log.contains("enu"), "{log}");
    assert!(!log.contains("\"started\""), "it is told before the training: {log}");
}

/// What a training was begun with counts until its end, with or without the aggregator.
#[test]
fn a_training_resumes_with_its_cell_without_the_aggregator() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let (station, broker) = ground(folder, "");
    let drone = drone(folder, "drone-1", &broker, "steps = 100000\nthreads = 1\n");
    let begun = Instant::now();
    let running = agent(&drone);
    while !drone.join("out/checkpoint/state.bin").exists() {
        assert!(begun.elapsed() < PATIENCE, "{}", running.log());
        sleep(Duration::from_millis(50));
    }
    let before = choice(&running.log());
    drop(running);
    drop(station);
    let started = |words: &[&str]| {
        fs::File::create(drone.join("cosurf-agent.log")).unwrap().flush().unwrap();
        let running = Running::start("cosurf-agent", &drone, words);
        while !running.log().contains("\"started\"") {
            assert!(begun.elapsed() < PATIENCE, "{}", running.log());
            sleep(Duration::from_millis(20));
        }
        running.log()
    };
    let resumed = started(&["run", "--json"]);
    assert!(before.0 == ChosenBy::Cell && choice(&resumed) == before);
    assert!(!resumed.contains("\"resumed_at\":0"), "{resumed}");
    let fresh = started(&["run", "--json", "--fresh"]);
    assert!(fresh.contains("\"resumed_at\":0") && choice(&fresh) != before, "nothing counts: {fresh}");
}

#[test]
fn a_bad_plan_is_refused_at_the_start_with_file_and_reason() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let text = "site = \"site\"\nout = \"ground\"\nbind = \"127.0.0.1:0\"\nplan = \"cells.geojson\"\n";
    fs::write(folder.join("aggregator.toml"), text).unwrap();
    for (cells, reason) in [
        (geojson().replace("drone-2", "drone-1"), "cells.geojson: cell 2 is the second one of drone-1"),
        (geojson().replace("device", "name"), "cells.geojson: cell 1 has no property `device`"),
        ("{".to_owned(), "cells.geojson: not valid GeoJSON"),
    ] {
        fs::write(folder.join("cells.geojson"), cells).unwrap();
        let (ended_well, log) = Running::start("cosurf-aggregator", folder, &["run"]).end();
        assert!(!ended_well && log.contains(reason), "{log}");
    }
}
