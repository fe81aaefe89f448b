//! A service that is started by hand, with agents started by hand, leaves what a mission of the same agents leaves.
#![cfg(unix)]
#![allow(clippy::unwrap_used)]

use std::fs;
use std::net::TcpListener;
use std::path::Path;
use std::process::{Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use cosurf_aggregator::report::{MissionReport, SiteReport};
use cosurf_tests::datasets::write_city;
use cosurf_tests::programs::program;
use cosurf_tests::running::{PATIENCE, Running};
use serde::de::DeserializeOwned;

fn read<T: DeserializeOwned>(path: &Path) -> T {
    serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
}

/// Runs a mission of two agents in `out`.
fn fly(data: &Path, out: &Path) {
    let mut command = Command::new(program("cosurf-aggregator"));
    command.args(["mission", "--agents", "2", "--steps", "60", "--data"]).arg(data).arg("--out").arg(out);
    let output = command.stdin(Stdio::null()).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

/// The configuration of a mission's agent, for another site, broker and folder.
fn moved(agent: &Path, broker: &str) -> String {
    let text = fs::read_to_string(agent.join("agent.toml")).unwrap();
    let lines = text.lines().map(|line| match line.split_once(" = ") {
        Some(("site", _)) => "site = \"site\"".into(),
        Some(("broker", _)) => format!("broker = \"mqtt://{broker}\""),
        Some(("out", _)) => "out = \"out\"".into(),
        _ => line.to_owned(),
    });
    lines.map(|line| line + "\n").collect()
}

fn await_report(station: &Running) {
    let begun = Instant::now();
    while !station.log().contains("\"event\":\"reported\"") {
        assert!(begun.elapsed() < PATIENCE, "{}", station.log());
        sleep(Duration::from_millis(50));
    }
}

#[test]
fn a_service_leaves_the_files_and_figures_of_a_mission() {
    let folder = tempfile::tempdir().unwrap();
    let (data, mission) = (folder.path().join("data"), folder.path().join("mission"));
    write_city(&data, 60.0, 16, [160, 120]);
    fly(&data, &mission);
    let address = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().to_string();
    let text = format!("site = \"site\"\nout = \"out\"\nbind = \"{address}\"\nquorum = 2\nquiet_s = 0\n");
    fs::write(folder.path().join("aggregator.toml"), text).unwrap();
    let start = || Running::start("cosurf-aggregator", folder.path(), &["run", "--json"]);
    let station = start();
    let agents = ["agent-1", "agent-2"].map(|name| {
        let at = folder.path().join(name);
        fs::create_dir_all(&at).unwrap();
        fs::write(at.join("agent.toml"), moved(&mission.join("agents").join(name), &address)).unwrap();
        Running::start("cosurf-agent", &at, &["run"])
    });
    for agent in agents {
        let (is_well, log) = agent.end();
        assert!(is_well, "{log}");
    }
    await_report(&station);
    let out = folder.path().join("out");
    for name in ["global.ply", "cameras.json", "mesh.ply"] {
        assert_eq!(fs::read(mission.join(name)).unwrap(), fs::read(out.join(name)).unwrap(), "{name}");
    }
    let whole = read::<MissionReport>(&mission.join("report.json")).whole;
    let report: SiteReport = read(&out.join("report.json"));
    let (merging, of_mission) = (&report.merging, whole.merging.unwrap());
    assert_eq!(report.mesh, whole.mesh);
    assert_eq!((merging.summary.splats, merging.revision), (whole.splats, whole.revision));
    assert_eq!((&merging.summary, &merging.fits), (&of_mission.summary, &of_mission.fits));
    let page = fs::read_to_string(out.join("report.html")).unwrap();
    assert!(page.contains("src=\"data:image/jpeg;base64,") && page.contains("agent-2"));
    // A report that is there is not made again; a damaged mesh is.
    drop(station);
    let log = folder.path().join("cosurf-aggregator.log");
    let sound = fs::read(out.join("mesh.ply")).unwrap();
    for damage in [false, true] {
        fs::remove_file(&log).unwrap();
        if damage {
            fs::write(out.join("mesh.ply"), &sound[..sound.len() / 2]).unwrap();
        }
        let station = start();
        match damage {
            true => await_report(&station),
            false => {
                let begun = Instant::now();
                while begun.elapsed() < Duration::from_secs(3) {
                    sleep(Duration::from_millis(50));
                }
                assert!(!station.log().contains("\"event\":\"reported\""), "{}", station.log());
            }
        }
        assert!(fs::read(out.join("mesh.ply")).unwrap() == sound);
    }
}
