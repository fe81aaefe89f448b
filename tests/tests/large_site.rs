//! An agent with little memory on a site whose global model is far larger than that.
#![cfg(target_os = "linux")]
#![allow(clippy::unwrap_used)]

use std::fs;
use std::net::TcpListener;
use std::path::Path;
use std::process::{Child, Command, Stdio};

use cosurf_link::{ModelStore, Offer};
use cosurf_scene::splats::SH_C0;
use cosurf_scene::{Camera, LocalFrame, Pose, Splats, ply};
use cosurf_tests::datasets::write_city;
use cosurf_tests::programs::program;
use cosurf_tests::usage::watch;
use cosurf_wire::{DeviceId, FrameId, ModelId, ModelKind};
use glam::{DVec2, DVec3};

/// What the agent may take, bytes.
const AGENT_BYTES: u64 = 200 << 20;
/// Splats of each of the other devices along each axis, and their distance, metres.
const ACROSS: usize = 320;
const SPACING_M: f32 = 0.3;
/// The other devices' ground is this far apart, metres: it overlaps a little.
const PITCH_M: f32 = 93.0;
/// Width of the ground that the agent flies over, metres.
const CITY_M: f32 = 40.0;

/// Flat opaque ground with its corner at `west` and `south`, and cameras above it.
fn ground(west: f32, south: f32) -> (Splats, Vec<Camera>) {
    let mut splats = Splats::with_capacity(ACROSS * ACROSS, 1);
    for i in 0..ACROSS * ACROSS {
        let (x, y) = (west + SPACING_M * (i % ACROSS) as f32, south + SPACING_M * (i / ACROSS) as f32);
        let shade = 0.5 + 0.3 * (0.7 * x).sin() * (0.5 * y).cos();
        let mut sh = [0.01; 12];
        for (of, value) in sh.iter_mut().zip([shade, 0.6 * shade, 1.0 - shade]) {
            *of = (value - 0.5) / SH_C0;
        }
        splats.push([x, y, 0.0], [1.0, 0.0, 0.0, 0.0], [-1.7, -1.7, -5.0], 4.0, &sh);
    }
    let above = |x: f64, y: f64| Camera {
        cam_from_world: Pose::look_at(DVec3::new(x, y, 20.0), DVec3::new(x, y, 0.0), DVec3::Y),
        focal_px: DVec2::splat(90.0),
        center_px: DVec2::new(72.0, 54.0),
        size_px: [144, 108],
    };
    let places = (0..16).map(|i| {
        let [x, y] = [i % 4, i / 4].map(|step| 12.0 + 24.0 * f64::from(step));
        above(f64::from(west) + x, f64::from(south) + y)
    });
    (splats, places.collect())
}

/// Puts the models of 23 devices around the agent's ground into the folder of a service. Returns the number of splats.
fn write_others(out: &Path) -> usize {
    let (store, _) = ModelStore::open(&out.join("models")).unwrap();
    let corners = (0..25).map(|i| [i % 5, i / 5]).filter(|at| *at != [2, 2]).skip(1);
    let mut count = 0;
    for (i, [column, row]) in corners.enumerate() {
        let [west, south] = [column, row].map(|step| PITCH_M * (step as f32 - 2.5));
        let (splats, cameras) = ground(west, south);
        let device = DeviceId::new(&format!("other-{i}")).unwrap();
        let offer = Offer::new(device, ModelId(1), ModelKind::Local, 16, &splats, &cameras);
        let Offer { mut header, body } = offer.unwrap();
        header.frame = FrameId::new("site").unwrap();
        store.put(&header, &body).unwrap();
        count += splats.len();
    }
    count
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
