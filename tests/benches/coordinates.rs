//! Trains and meshes one scene at several places in the world and in several units, and compares the results.
//!
//! `cargo bench -p cosurf-tests --bench coordinates -- --help`

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result, ensure};
use clap::Parser;
use cosurf_aggregator::evaluate::accuracy::judge;
use cosurf_scene::Mesh;
use cosurf_tests::coordinates::{Coordinates, UTM};
use cosurf_tests::programs::program;
use cosurf_tests::results::{Better, Column, Measurement, Tolerance};

/// Two surfaces agree where they are at most so many voxels apart. Trees and bare ground differ by more between two
/// trainings of one scene with different seeds, so the row of another seed tells what the figures can be.
const THRESHOLDS_VOXELS: [f64; 2] = [2.0, 16.0];

/// Train and mesh a scene in other coordinates. Prints a table, and writes JSON to target/results.
#[derive(Parser)]
struct Arguments {
    /// A dataset whose world coordinates are metres near the origin, with z up
    data: PathBuf,
    /// Training steps
    #[arg(long, default_value_t = 600)]
    steps: u32,
    /// Long side of the pictures, px
    #[arg(long, default_value_t = 320)]
    max_size: u32,
    /// Passed by cargo to every bench
    #[arg(long, hide = true)]
    bench: bool,
}

fn main() -> Result<()> {
    let arguments = Arguments::parse();
    let folder = tempfile::tempdir()?;
    let agrees = |voxels: f64| {
        let name = format!("surface at {voxels} voxels");
        Column::new(&name, "F-score", 3).guarded(Better::Higher, Tolerance::Absolute(0.02))
    };
    let psnr = Column::new("PSNR", "dB", 2).guarded(Better::Higher, Tolerance::Absolute(0.3));
    let columns: Vec<Column> = [psnr].into_iter().chain(THRESHOLDS_VOXELS.map(agrees)).collect();
    let mut measurement = Measurement::start("coordinates", &columns);
    let mut first: Option<(Mesh, f64)> = None;
    for (i, (name, coordinates)) in rows().into_iter().enumerate() {
        let folder = folder.path().join(i.to_string());
        coordinates.write(&arguments.data, &folder)?;
        let psnr = train(&arguments, &folder, u64::from(i == 1))?;
        let (mesh, voxel_m) = mesh(&folder)?;
        let mesh = coordinates.mesh_back(mesh);
        let mut figures = vec![Some(psnr)];
        for voxels in THRESHOLDS_VOXELS {
            let agrees = first.as_ref().map(|(own, voxel_m)| judge(&mesh, own, voxels * voxel_m, 0));
            figures.push(agrees.transpose()?.map(|(accuracy, _)| accuracy.samples.f_score));
        }
        first.get_or_insert((mesh, voxel_m));
        measurement.row(&name, &figures);
    }
    measurement.finish()?;
    Ok(())
}

/// The rows of the table.
fn rows() -> Vec<(String, Coordinates)> {
    let mut rows = vec![
        ("as they are".into(), Coordinates::OWN),
        ("another seed".into(), Coordinates::OWN),
        ("UTM".into(), Coordinates::at(UTM)),
        ("ECEF".into(), Coordinates::ecef()),
    ];
    let scales = [-4, -3, -2, -1, 1, 2, 3, 4, 5];
    rows.extend(scales.map(|e| (format!("times 10^{e}"), Coordinates::times(10f64.powi(e)))));
    rows
}

/// Trains on a dataset's folder, into it. Returns the PSNR of the held-out views, dB.
fn train(arguments: &Arguments, folder: &Path, seed: u64) -> Result<f64> {
    let (steps, max_size) = (arguments.steps.to_string(), arguments.max_size.to_string());
    let mut command = Command::new(program("cosurf-agent"));
    command.arg("train").arg(folder).arg("--out").arg(folder.join("out"));
    command.args(["--steps", &steps, "--max-size", &max_size, "--compute", "cpu"]);
    command.args(["--seed", &seed.to_string()]);
    run(&mut command)?;
    let report: serde_json::Value =
        serde_json::from_slice(&fs::read(folder.join("out").join("report.json"))?)?;
    report["psnr"].as_f64().context("the report has no PSNR")
}

/// Makes the mesh of the trained model. Also returns the edge length of a voxel.
fn mesh(folder: &Path) -> Result<(Mesh, f64)> {
    let file = folder.join("mesh.ply");
    let mut command = Command::new(program("cosurf-aggregator"));
    command.arg("mesh").arg(folder.join("out")).arg("--cameras").arg(folder);
    command.arg("--out").arg(&file).args(["--max-size", "320", "--json"]);
    let out = run(&mut command)?;
    let last = out.lines().last().context("mesh prints nothing")?;
    let line: serde_json::Value = serde_json::from_str(last)?;
    Ok((Mesh::read(&file)?, line["voxel_m"].as_f64().context("mesh tells no voxel")?))
}

/// Runs a command, and returns what it printed.
fn run(command: &mut Command) -> Result<String> {
    let out = command.output()?;
    ensure!(out.status.success(), "{command:?}: {}", String::from_utf8_lossy(&out.stderr));
    Ok(String::from_utf8(out.stdout)?)
}
