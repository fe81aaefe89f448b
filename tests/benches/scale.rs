//! Measures what a merge takes on sites of many devices ([`districts`]).
//!
//! `cargo bench -p cosurf-tests --bench scale -- --help`

mod districts;

use std::path::PathBuf;
use std::process::{Command, Stdio};

use anyhow::{Result, ensure};
use clap::Parser;
use cosurf_tests::programs::program;
use cosurf_tests::results::{Better, Column, Measurement, Tolerance};
use cosurf_tests::usage::{Usage, watch};
use districts::{Districts, Site};

/// Measure merges of sites with many devices. Prints a table, and writes JSON to target/results.
#[derive(Parser)]
struct Arguments {
    #[command(flatten)]
    districts: Districts,
    /// Numbers of devices of the sites
    #[arg(long, value_name = "N", default_value = "16,64", value_delimiter = ',')]
    devices: Vec<usize>,
    /// Epochs of the distillation
    #[arg(long, value_name = "N", default_value_t = 4)]
    epochs: u32,
    /// Limit on the memory of the merge
    #[arg(long, value_name = "BYTES", default_value = "4GiB")]
    memory: String,
    /// Folder for the sites [default: a temporary folder]
    #[arg(long, value_name = "DIR")]
    folder: Option<PathBuf>,
    /// Passed by cargo to every bench
    #[arg(long, hide = true)]
    bench: bool,
}

fn main() -> Result<()> {
    let arguments = Arguments::parse();
    let temporary = tempfile::tempdir()?;
    let folder = arguments.folder.as_deref().unwrap_or(temporary.path());
    let splats = Column::new("splats", "million", 2);
    let cameras = Column::new("cameras", "", 0);
    let peak = Column::new("peak memory", "MiB", 0).guarded(Better::Lower, Tolerance::Relative(0.1));
    let cpu = Column::new("processor time for each splat", "µs", 0);
    let wall = Column::new("time", "s", 0);
    let mut measurement = Measurement::start("scale", &[splats, cameras, peak, cpu, wall]);
    for devices in &arguments.devices {
        let site = arguments.districts.write(&folder.join(format!("{devices}")), *devices)?;
        let usage = merge(&site, &arguments)?;
        let cpu_us = 1e6 * usage.cpu_s / site.splats as f64;
        let row = [
            site.splats as f64 / 1e6,
            site.cameras as f64,
            usage.peak_bytes as f64 / f64::from(1 << 20),
            cpu_us,
            usage.wall_s,
        ];
        measurement.row(&format!("{devices} devices"), &row.map(Some));
    }
    measurement.finish()?;
    Ok(())
}

/// Merges a site in a process of its own.
fn merge(site: &Site, arguments: &Arguments) -> Result<Usage> {
    let mut command = Command::new(program("cosurf-aggregator"));
    command.arg("merge").args(&site.folders).arg("--out").arg(&site.out);
    command.args(["--same-frame", "--json", "--compute", "cpu", "--memory", &arguments.memory]);
    command.args(["--epochs", &arguments.epochs.to_string()]);
    let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn()?;
    let usage = watch(&mut child);
    ensure!(usage.succeeded, "the merge of {} devices failed", site.folders.len());
    Ok(usage)
}
