//! An agent with little memory on a site whose global model is far larger than that.
#![cfg(target_os = "linux")]
#![allow(clippy::unwrap_used)]

use std::fs;
use std::net::TcpListener;
use std::path::Path;
use std::process::{Child, Command, Stdio};

use cosurf_scene::{LocalFrame, ply};
use cosurf_tests::datasets::write_city;
use cosurf_tests::programs::program;
use cosurf_tests::usage::watch;
use cosurf_tests::wide_ground::write_models;

/// What the agent may take, bytes.
const AGENT_BYTES: u64 = 200 << 20;
/// The other devices' ground is this far apart, metres: it overlaps a little.
const PITCH_M: f32 = 93.0;
/// Width of the ground that the agent flies over, metres.
const CITY_M: f32 = 40.0;

/// Puts the models of 23 devices around the agent's ground into the folder of a service. Returns the number of splats.
fn write_others(out: &Path) -> usize {
    let places = (0..25).map(|i| [i % 5, i / 5]).filter(|at| *at != [2, 2]).skip(1);
    let corners: Vec<[f32; 2]> = places.map(|at| at.map(|step| PITCH_M * (step as f32 - 2.5))).collect();
    write_models(out, &corners, 1)
}

/// A ground station; killed when dropped.
struct Aggregator(Child);

impl Drop for Aggregator {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn run(program_name: &str, config: &Path, text: &str) -> Command {
    fs::write(config, text).unwrap();
    let mut command = Command::new(program(program_name));
    command.args(["run", "--config"]).arg(config).stdin(Stdio::null());
    command
}

#[test]
#[ignore = "takes minutes"]
fn an_agent_gets_its_tiles_of_a_site_of_two_million_splats_within_its_memory() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    write_city(&path("city"), f64::from(CITY_M), 12, [96, 72]);
    let others = write_others(&path("station"));
    let text = format!(
        "site = \"site\"\nframe = \"site\"\nout = {:?}\nbind = \"127.0.0.1:{port}\"\nquorum = 24\n\
         compute = \"cpu\"\n",
        path("station")
    );
    let mut station = run("cosurf-aggregator", &path("aggregator.toml"), &text);
    let _station = Aggregator(station.spawn().unwrap());
    let text = format!(
        "device = \"drone\"\nsite = \"site\"\nframe = \"site\"\nbroker = \"mqtt://127.0.0.1:{port}\"\n\
         data = {:?}\nout = {:?}\nsteps = 60\ncompute = \"cpu\"\nmemory_bytes = {AGENT_BYTES}\n\
         wait_global = true\n",
        path("city"),
        path("drone")
    );
    let mut agent = run("cosurf-agent", &path("agent.toml"), &text).spawn().unwrap();
    let usage = watch(&mut agent);
    assert!(usage.succeeded);
    assert!(usage.peak_bytes <= AGENT_BYTES, "{} bytes", usage.peak_bytes);
    let all = ply::read(&path("station/global.ply"), &LocalFrame::WORLD).unwrap();
    let its = ply::read(&path("drone/global.ply"), &LocalFrame::WORLD).unwrap();
    let files = fs::read_dir(path("drone/global")).unwrap().flatten();
    let received: u64 = files.map(|file| file.metadata().unwrap().len()).sum();
    println!(
        "{} of {} splats in {received} bytes, {} bytes of memory, {:.0} s",
        its.len(),
        all.len(),
        usage.peak_bytes,
        usage.wall_s
    );
    assert!(all.len() > others / 2, "{} of {others} splats", all.len());
    let own = |means: &[[f32; 3]]| {
        means.iter().filter(|mean| mean[0].abs().max(mean[1].abs()) < 0.4 * CITY_M).count()
    };
    assert_eq!(own(&its.means), own(&all.means), "all splats of its ground");
    assert!(its.len() < all.len() / 5, "{} of {} splats", its.len(), all.len());
}
