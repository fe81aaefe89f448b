//! Measures how much faster several workers, or several threads of one process, merge a site ([`districts`]). The workers
//! are processes of one thread each; a NATS server hands them their tiles.
//!
//! `cargo bench -p cosurf-tests --bench workers -- --help`

mod districts;

use std::path::Path;
use std::process::{Child, Command, Stdio};

use anyhow::{Context, Result, ensure};
use clap::Parser;
use cosurf_tests::nats::Nats;
use cosurf_tests::programs::program;
use cosurf_tests::results::{Better, Column, Measurement, Tolerance};
use cosurf_tests::usage::watch;
use districts::{Districts, Site};

/// Measure how much faster several workers merge a site. Prints a table, and writes JSON to target/results.
#[derive(Parser)]
struct Arguments {
    #[command(flatten)]
    districts: Districts,
    /// Number of devices of the site
    #[arg(long, value_name = "N", default_value_t = 16)]
    devices: usize,
    /// Passed by cargo to every bench
    #[arg(long, hide = true)]
    bench: bool,
}

/// Who distils the tiles of a merge.
#[derive(Clone, Copy)]
enum By {
    /// The merge itself, on so many processors.
    Itself(usize),
    /// So many workers.
    Workers(usize),
}

const CASES: [(&str, By); 4] = [
    ("one process on one core", By::Itself(1)),
    ("one process on two cores", By::Itself(2)),
    ("one worker", By::Workers(1)),
    ("two workers", By::Workers(2)),
];

fn main() -> Result<()> {
    let arguments = Arguments::parse();
    let folder = tempfile::tempdir()?;
    let site = arguments.districts.write(&folder.path().join("site"), arguments.devices)?;
    let nats = Nats::start(&folder.path().join("nats")).context("nats-server is not installed")?;
    let ratio = |name| Column::new(name, "", 2).guarded(Better::Lower, Tolerance::Absolute(0.03));
    let columns = [
        Column::new("whole merge", "s", 1),
        Column::new("before and after the tiles", "s", 1),
        Column::new("tiles", "s", 1),
        ratio("tiles, share of one"),
    ];
    let mut measurement = Measurement::start("workers", &columns);
    let mut one_s = None;
    for (i, (name, by)) in CASES.into_iter().enumerate() {
        let tiles = folder.path().join(format!("tiles-{i}"));
        let whole_s = merge_s(&site, &tiles, by, &nats)?;
        // All tiles are known now.
        let beside_s = merge_s(&site, &tiles, by, &nats)?;
        let tiles_s = whole_s - beside_s;
        // The cases come in pairs: one, then two.
        let one_s = if i % 2 == 0 { *one_s.insert(tiles_s) } else { one_s.unwrap_or(tiles_s) };
        measurement.row(name, &[whole_s, beside_s, tiles_s, tiles_s / one_s].map(Some));
    }
    measurement.finish()?;
    Ok(())
}

/// Merges a site. Returns the time that it takes, seconds.
fn merge_s(site: &Site, tiles: &Path, by: By, nats: &Nats) -> Result<f64> {
    let mut command = match by {
        By::Itself(1) => on_one_core(),
        _ => Command::new(program("cosurf-aggregator")),
    };
    command.arg("merge").args(&site.folders).arg("--out").arg(&site.out);
    command.args(["--same-frame", "--json", "--compute", "cpu", "--tiles"]).arg(tiles);
    let workers = if let By::Workers(count) = by { count } else { 0 };
    if workers > 0 {
        command.args(["--queue", &nats.url()]);
    }
    let _workers = (0..workers).map(|_| Worker::start(tiles, nats)).collect::<Result<Vec<_>>>()?;
    let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn()?;
    let usage = watch(&mut child);
    ensure!(usage.succeeded, "the merge failed");
    Ok(usage.wall_s)
}

/// The aggregator on the first processor alone. Linux only.
fn on_one_core() -> Command {
    let mut command = Command::new("taskset");
    command.args(["-c", "0"]).arg(program("cosurf-aggregator"));
    command
}

/// A worker of one thread, which is killed when this value is dropped.
struct Worker(Child);

impl Worker {
    fn start(tiles: &Path, nats: &Nats) -> Result<Self> {
        let mut command = Command::new(program("cosurf-aggregator"));
        command.args(["worker", "--compute", "cpu", "--threads", "1", "--queue", &nats.url(), "--tiles"]);
        Ok(Self(command.arg(tiles).stdout(Stdio::null()).stderr(Stdio::null()).spawn()?))
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
