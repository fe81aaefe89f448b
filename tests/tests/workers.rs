//! Merges whose tiles are distilled by workers: other processes, which are killed at random, with a queue that is away
//! for a while and a bucket that fails now and then. The result has the bytes of a merge in one process.
#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::thread::sleep;
use std::time::Duration;

use cosurf_scene::splats::SH_C0;
use cosurf_scene::{Camera, LocalFrame, Pose, Splats, ply};
use cosurf_tests::dice::Dice;
use cosurf_tests::nats::Nats;
use cosurf_tests::programs::program;
use cosurf_tests::s3::S3;
use glam::{DVec2, DVec3};

/// Number of merges that are disturbed in the test that runs on request.
const RUNS: u64 = 30;

/// The ground from x = `west` to `west` + 60 m, 48 m wide: flat opaque splats, 0.3 m apart, and cameras above it.
fn write_model(folder: &Path, west: f32) {
    let mut splats = Splats::with_capacity(0, 0);
    for i in 0..200 {
        for j in -80..80 {
            let (x, y) = (west + 0.3 * i as f32, 0.3 * j as f32);
            let shade = 0.5 + 0.3 * (0.7 * x).sin() * (0.5 * y).cos();
            let sh = [shade, 0.6 * shade, 1.0 - shade].map(|value| (value - 0.5) / SH_C0);
            splats.push([x, y, 0.0], [1.0, 0.0, 0.0, 0.0], [-1.7, -1.7, -5.0], 4.0, &sh);
        }
    }
    let above = |x: f64, y: f64| Camera {
        cam_from_world: Pose::look_at(DVec3::new(x, y, 12.0), DVec3::new(x, y, 0.0), DVec3::Y),
        focal_px: DVec2::splat(60.0),
        center_px: DVec2::new(48.0, 32.0),
        size_px: [96, 64],
    };
    let places = (0..8).flat_map(|i| (-2..=2).map(move |j| (6.0 + 7.0 * f64::from(i), 8.0 * f64::from(j))));
    let cameras: Vec<Camera> = places.map(|(x, y)| above(f64::from(west) + x, y)).collect();
    fs::create_dir_all(folder).unwrap();
    ply::write(&folder.join("model.ply"), &splats, &LocalFrame::WORLD).unwrap();
    fs::write(folder.join("cameras.json"), serde_json::to_string(&cameras).unwrap()).unwrap();
}

/// Every so many requests to the bucket, one fails.
const FAIL_EVERY: u64 = 10;

/// Two models that share a strip of ground, a store, and a queue.
struct Site {
    folder: tempfile::TempDir,
    nats: Nats,
    /// The server of the store; without it, the tiles are in folders.
    s3: Option<S3>,
}

impl Site {
    fn new() -> Option<Self> {
        let folder = tempfile::tempdir().unwrap();
        let nats = Nats::start(&folder.path().join("nats"))?;
        for (name, west) in [("a", -50.0), ("b", -10.0)] {
            write_model(&folder.path().join(name), west);
        }
        Some(Self { folder, nats, s3: None })
    }

    /// Keeps the tiles in a bucket.
    fn in_bucket(self, fail_every: u64) -> Self {
        Self { s3: Some(S3::start(&self.path("s3"), fail_every)), ..self }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// The command that merges the models, with its output in the folder `out`.
    fn merge(&self, out: &str, by_workers: bool) -> Command {
        let mut command = Command::new(program("cosurf-aggregator"));
        command.arg("merge").arg(self.path("a")).arg(self.path("b")).arg("--out").arg(self.path(out));
        command.args(["--json", "--compute", "cpu", "--epochs", "3"]);
        self.keep_tiles(&mut command, out);
        if by_workers {
            command.args(["--queue", self.nats.url().as_str()]);
        }
        command.stdout(Stdio::piped()).stderr(Stdio::piped());
        command
    }

    fn worker(&self, out: &str, more: &[&str]) -> Worker {
        let mut command = Command::new(program("cosurf-aggregator"));
        command.args(["worker", "--compute", "cpu", "--threads", "1", "--queue", self.nats.url().as_str()]);
        self.keep_tiles(&mut command, out);
        command.args(more);
        Worker(command.stdout(Stdio::null()).spawn().unwrap())
    }

    fn keep_tiles(&self, command: &mut Command, out: &str) {
        let name = format!("{out}-tiles");
        match &self.s3 {
            Some(s3) => command.args(["--tiles", s3.url(&name).as_str()]).envs(s3.environment()),
            None => command.arg("--tiles").arg(self.path(&name)),
        };
    }

    fn bytes(&self, out: &str) -> Vec<u8> {
        fs::read(self.path(out).join("global.ply")).unwrap()
    }
}

/// A worker, which is killed when this value is dropped.
struct Worker(Child);

impl Drop for Worker {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn succeed(output: &Output) -> serde_json::Value {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn workers_give_the_bytes_of_a_single_process() {
    let Some(site) = Site::new() else { return };
    let alone = succeed(&site.merge("alone", false).output().unwrap());
    assert!(alone["merge"]["tiles"].as_u64().unwrap() >= 3, "{alone}");
    let _workers = [site.worker("by", &[]), site.worker("by", &[])];
    let by_workers = succeed(&site.merge("by", true).output().unwrap());
    assert_eq!(by_workers["merge"]["known_tiles"], 0, "{by_workers}");
    assert_eq!(site.bytes("by"), site.bytes("alone"));
    let again = succeed(&site.merge("by", true).output().unwrap());
    assert_eq!(again["merge"]["known_tiles"], alone["merge"]["tiles"], "{again}");
    let left = fs::read_dir(site.path("by-tiles")).unwrap().count();
    assert_eq!(left as u64, alone["merge"]["tiles"].as_u64().unwrap(), "only results are left");
}

#[test]
fn a_tile_that_no_worker_can_distil_fails_the_merge_with_the_reason() {
    let Some(site) = Site::new() else { return };
    let _worker = site.worker("by", &["--memory", "4MiB"]);
    let output = site.merge("by", true).output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success() && error.contains("--memory"), "{error}");
}

#[test]
fn a_queue_that_is_not_there_is_told_at_once() {
    let folder = tempfile::tempdir().unwrap();
    let mut command = Command::new(program("cosurf-aggregator"));
    command.args(["worker", "--queue", "nats://127.0.0.1:1", "--tiles"]).arg(folder.path());
    let output = command.output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success() && error.contains("nats-server -js"), "{error}");
}

#[test]
fn a_bucket_that_fails_now_and_then_gives_the_same_bytes() {
    let Some(site) = Site::new() else { return };
    succeed(&site.merge("alone", false).output().unwrap());
    let site = site.in_bucket(FAIL_EVERY);
    let _workers = [site.worker("by", &[]), site.worker("by", &[])];
    let by_workers = succeed(&site.merge("by", true).output().unwrap());
    assert_eq!(by_workers["merge"]["known_tiles"], 0, "{by_workers}");
    assert_eq!(site.bytes("by"), site.bytes("alone"));
    let again = succeed(&site.merge("by", false).output().unwrap());
    assert_eq!(again["merge"]["known_tiles"], again["merge"]["tiles"], "{again}");
    let left = fs::read_dir(site.path("s3/site/by-tiles")).unwrap().count();
    assert_eq!(left as u64, again["merge"]["tiles"].as_u64().unwrap(), "only results are left");
}

#[test]
fn a_bucket_that_refuses_or_is_not_there_is_told_at_once() {
    let Some(site) = Site::new() else { return };
    let site = site.in_bucket(0);
    let told = |variable: &str, value: &str, place: &str, reason: &str| {
        let mut command = Command::new(program("cosurf-aggregator"));
        command.args(["worker", "--queue", site.nats.url().as_str(), "--tiles", place]);
        command.envs(site.s3.as_ref().unwrap().environment()).env(variable, value);
        let output = command.output().unwrap();
        let error = String::from_utf8_lossy(&output.stderr);
        assert!(!output.status.success() && error.contains(reason), "{error}");
        assert_eq!(error.lines().count(), 1, "{error}");
    };
    told("AWS_SECRET_ACCESS_KEY", "another", "s3://site/by", "AWS_SECRET_ACCESS_KEY");
    told("AWS_ENDPOINT_URL", "http://127.0.0.1:1", "s3://site/by", "AWS_ENDPOINT_URL");
    told("UNUSED", "", "s3://another/by", "the bucket exists");
    told("UNUSED", "", "ftp://site/by", "s3://bucket/prefix");
}

/// One merge. Workers and the merge are killed at random, and so is the queue.
fn disturbed(site: &mut Site, seed: u64) -> Vec<u8> {
    let out = format!("run-{seed}");
    let mut dice = Dice(seed);
    let mut workers = [site.worker(&out, &[]), site.worker(&out, &[])];
    let mut merge = site.merge(&out, true).spawn().unwrap();
    let mut disturbances = 0;
    let status = loop {
        sleep(Duration::from_millis((100 + dice.below(400)) as u64));
        if let Some(status) = merge.try_wait().unwrap() {
            break status;
        }
        if disturbances == 4 {
            continue;
        }
        disturbances += 1;
        match dice.below(4) {
            0 => {
                merge.kill().unwrap();
                merge.wait().unwrap();
                merge = site.merge(&out, true).spawn().unwrap();
            }
            1 => {
                site.nats.kill();
                sleep(Duration::from_millis(dice.below(1500) as u64));
                site.nats.start_again();
            }
            _ => {
                let killed = dice.below(2);
                workers[killed] = site.worker(&out, &[]);
            }
        }
    };
    assert!(status.success(), "seed {seed}");
    site.bytes(&out)
}

#[test]
fn a_killed_worker_and_a_restarted_queue_change_nothing() {
    let Some(mut site) = Site::new() else { return };
    succeed(&site.merge("alone", false).output().unwrap());
    let alone = site.bytes("alone");
    assert!(disturbed(&mut site, 1) == alone);
}

#[test]
#[ignore = "takes minutes"]
fn kills_of_workers_merges_and_the_queue_change_nothing() {
    let Some(site) = Site::new() else { return };
    succeed(&site.merge("alone", false).output().unwrap());
    let alone = site.bytes("alone");
    let mut site = site.in_bucket(FAIL_EVERY);
    for seed in 0..RUNS {
        assert!(disturbed(&mut site, seed) == alone, "seed {seed}");
        println!("seed {seed} of {RUNS}: the same bytes");
    }
}
