//! Measures what a merge takes on sites of many devices. The sites are made of one mission, repeated at offsets: the
//! models of its agents, with their cameras, on a square grid of districts.
//!
//! `cargo bench -p cosurf-tests --bench scale -- --help`

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, Result, ensure};
use clap::Parser;
use cosurf_link::Model;
use cosurf_scene::{Camera, Pose, ply};
use cosurf_tests::models::read_model;
use cosurf_tests::programs::program;
use cosurf_tests::results::{Better, Column, Measurement, Tolerance};
use cosurf_tests::usage::watch;
use glam::DVec3;

/// Measure merges of sites with many devices. Prints a table, and writes JSON to target/results.
#[derive(Parser)]
struct Arguments {
    /// Output folders of a mission's agents
    #[arg(required = true)]
    agents: Vec<PathBuf>,
    /// Numbers of devices of the sites
    #[arg(long, value_name = "N", default_value = "16,64", value_delimiter = ',')]
    devices: Vec<usize>,
    /// Distance between two districts, world units [default: the width of the mission's cameras, 1.5 times]
    #[arg(long, value_name = "UNITS")]
    pitch: Option<f64>,
    /// Axis of the world that is vertical: 0, 1 or 2
    #[arg(long, value_name = "AXIS", default_value_t = 2)]
    vertical: usize,
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
    let models = arguments.agents.iter().map(|agent| read_model(agent)).collect::<Result<Vec<_>>>()?;
    let pitch = arguments.pitch.unwrap_or_else(|| 1.5 * width(&models, arguments.vertical));
    let splats = Column::new("splats", "million", 2);
    let cameras = Column::new("cameras", "", 0);
    let peak = Column::new("peak memory", "MiB", 0).guarded(Better::Lower, Tolerance::Relative(0.1));
    let cpu = Column::new("processor time for each splat", "µs", 0);
    let wall = Column::new("time", "s", 0);
    let mut measurement = Measurement::start("scale", &[splats, cameras, peak, cpu, wall]);
    for devices in &arguments.devices {
        let site =
            Site::write(&folder.join(format!("{devices}")), &models, *devices, pitch, arguments.vertical)?;
        let usage = site.merge(&arguments)?;
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

/// Width of the box around all cameras, along the longer horizontal axis.
fn width(models: &[Model], vertical: usize) -> f64 {
    let cameras = || models.iter().flat_map(|model| &model.cameras);
    let places = || cameras().map(|camera| camera.cam_from_world.center());
    let low = places().fold(DVec3::INFINITY, DVec3::min);
    let size = places().fold(DVec3::NEG_INFINITY, DVec3::max) - low;
    size[(vertical + 1) % 3].max(size[(vertical + 2) % 3])
}

/// A site of many devices.
struct Site {
    folders: Vec<PathBuf>,
    out: PathBuf,
    splats: usize,
    cameras: usize,
}

impl Site {
    /// Writes the models of the first `devices` devices on a square grid of districts.
    fn write(folder: &Path, models: &[Model], devices: usize, pitch: f64, vertical: usize) -> Result<Self> {
        let across = (devices.div_ceil(models.len()) as f64).sqrt().ceil() as usize;
        let mut site = Self { folders: Vec::new(), out: folder.join("out"), splats: 0, cameras: 0 };
        for device in 0..devices {
            let (district, model) = (device / models.len(), &models[device % models.len()]);
            let mut offset = DVec3::ZERO;
            offset[(vertical + 1) % 3] = pitch * (district % across) as f64;
            offset[(vertical + 2) % 3] = pitch * (district / across) as f64;
            let its = folder.join(format!("device-{device:04}"));
            write(&its, &moved(model, offset)).with_context(|| its.display().to_string())?;
            site.splats += model.splats.len();
            site.cameras += model.cameras.len();
            site.folders.push(its);
        }
        Ok(site)
    }

    /// Merges the site in a process of its own.
    fn merge(&self, arguments: &Arguments) -> Result<cosurf_tests::usage::Usage> {
        let mut command = Command::new(program("cosurf-aggregator"));
        command.arg("merge").args(&self.folders).arg("--out").arg(&self.out);
        command.args(["--same-frame", "--json", "--device", "cpu", "--memory", &arguments.memory]);
        command.args(["--epochs", &arguments.epochs.to_string()]);
        let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn()?;
        let usage = watch(&mut child);
        ensure!(usage.succeeded, "the merge of {} devices failed", self.folders.len());
        Ok(usage)
    }
}

fn write(folder: &Path, model: &Model) -> Result<()> {
    fs::create_dir_all(folder)?;
    ply::write(&folder.join("model.ply"), &model.splats)?;
    fs::write(folder.join("cameras.json"), serde_json::to_string(&model.cameras)?)?;
    Ok(())
}

/// A model and its cameras, moved.
fn moved(model: &Model, by: DVec3) -> Model {
    let mut moved = model.clone();
    for mean in &mut moved.splats.means {
        *mean = (DVec3::from(mean.map(f64::from)) + by).as_vec3().to_array();
    }
    moved.cameras.iter_mut().for_each(|camera: &mut Camera| {
        let Pose { rotation, translation } = camera.cam_from_world;
        camera.cam_from_world = Pose { rotation, translation: translation - rotation * by };
    });
    moved
}
