//! Trains a scene with poses that are not exact, once as they are and once with poses that are learnt.
//!
//! `cargo bench -p cosurf-tests --bench poses -- --help`

mod surface;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result, ensure};
use clap::Parser;
use cosurf_contract::TrainReport;
use cosurf_scene::{Camera, Dataset, LocalFrame, Mesh, Pose, camera_list, colmap, model};
use cosurf_tests::datasets::{default_dataset, true_surface};
use cosurf_tests::dice::Dice;
use cosurf_tests::programs::program;
use cosurf_tests::results::{Better, Column, Measurement, Tolerance};
use glam::{DQuat, DVec3};

use surface::f_score;

/// Every eighth view is held out; its pose is exact.
const EVAL_EVERY: u32 = 8;
/// How wrong poses are: standard deviations of rotation about each axis, degrees, and of the position along each axis, as a
/// share of the extent.
const WRONG: [(f64, f64); 4] = [(0.0, 0.0), (0.05, 0.000_25), (0.2, 0.001), (1.0, 0.005)];

/// Train with poses that are not exact. Prints a table, and writes JSON to target/results.
#[derive(Parser)]
struct Arguments {
    /// Folder of a dataset with exact poses [default: gt_boruszyn or a city]
    #[arg(long, value_name = "DATA")]
    data: Option<PathBuf>,
    /// Shrink pictures until their long side is at most this many pixels
    #[arg(long, value_name = "PX", default_value_t = 240)]
    max_size: u32,
    /// Number of steps of each training
    #[arg(long, value_name = "N", default_value_t = 1500)]
    steps: u32,
    /// Largest distance from the true surface that counts as correct, metres
    #[arg(long, value_name = "M", default_value_t = 0.5)]
    threshold: f64,
    /// Name of the dataset, before the name of each row
    #[arg(long, value_name = "NAME", default_value = "")]
    name: String,
    /// Passed by cargo to every bench
    #[arg(long, hide = true)]
    bench: bool,
}

fn main() -> Result<()> {
    let arguments = Arguments::parse();
    let folder = tempfile::tempdir()?;
    let data = arguments.data.clone().unwrap_or_else(|| default_dataset(folder.path()));
    let truth = true_surface(&data).map(|file| Mesh::read(&file)).transpose()?;
    let mut measurement = Measurement::start("poses", &columns());
    for (i, (turn_deg, share)) in WRONG.into_iter().enumerate() {
        let wrong = folder.path().join(format!("wrong-{i}"));
        let exact = write(&data, &wrong, turn_deg, share)?;
        for poses in ["fixed", "auto"] {
            let report = train(&arguments, &wrong, poses)?;
            let out = wrong.join("out");
            let cameras = camera_list::read(&out.join(camera_list::FILE))?;
            let score = truth.as_ref().map(|truth| {
                let splats = model::read(&out.join("model.ply"), &LocalFrame::WORLD)?;
                f_score(splats, &cameras, truth, arguments.threshold)
            });
            let figures = [
                report.psnr,
                report.ssim,
                score.transpose()?,
                Some(median(exact.iter().zip(&cameras).map(|(exact, camera)| turned_deg(exact, camera)))),
                report.poses_moved_px,
            ];
            measurement.row(
                &format!("{}{turn_deg}°, {} %, {poses}", prefix(&arguments.name), 100.0 * share),
                &figures,
            );
        }
    }
    measurement.finish()?;
    Ok(())
}

fn prefix(name: &str) -> String {
    if name.is_empty() { String::new() } else { format!("{name}: ") }
}

fn columns() -> [Column; 5] {
    [
        Column::psnr("PSNR"),
        Column::ssim(),
        Column::f_score(),
        Column::new("rotation off", "°", 3).guarded(Better::Lower, Tolerance::Absolute(0.05)),
        Column::new("pictures moved", "px", 2),
    ]
}

/// Writes the dataset with wrong poses of its training views; the pictures are linked. Returns the exact cameras of these
/// views.
fn write(data: &Path, folder: &Path, turn_deg: f64, share: f64) -> Result<Vec<Camera>> {
    let mut dataset = Dataset::open(data)?;
    let (train, _) = dataset.split(EVAL_EVERY);
    let (mut dice, by) = (Dice(1), share * dataset.extent());
    let exact = train.iter().map(|i| dataset.views[*i].camera).collect();
    for i in train {
        let pose = &mut dataset.views[i].camera.cam_from_world;
        let turn = DQuat::from_scaled_axis(turn_deg.to_radians() * normal(&mut dice));
        let center = pose.center() + by * normal(&mut dice);
        let rotation = (turn * pose.rotation).normalize();
        *pose = Pose { rotation, translation: -(rotation * center) };
    }
    fs::create_dir_all(folder)?;
    std::os::unix::fs::symlink(fs::canonicalize(data)?.join("images"), folder.join("images"))?;
    colmap::write(folder, &dataset)?;
    Ok(exact)
}

/// Three normally distributed numbers.
fn normal(dice: &mut Dice) -> DVec3 {
    let mut one = || (0..12).map(|_| dice.unit() - 0.5).sum::<f64>();
    DVec3::new(one(), one(), one())
}

fn turned_deg(exact: &Camera, camera: &Camera) -> f64 {
    exact.cam_from_world.rotation.angle_between(camera.cam_from_world.rotation).to_degrees()
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Trains on a dataset's folder, into its folder `out`.
fn train(arguments: &Arguments, folder: &Path, poses: &str) -> Result<TrainReport> {
    let (steps, max_size, every) =
        (arguments.steps.to_string(), arguments.max_size.to_string(), EVAL_EVERY.to_string());
    let mut command = Command::new(program("cosurf-agent"));
    command.arg("train").arg(folder).arg("--out").arg(folder.join("out"));
    command.args(["--steps", &steps, "--max-size", &max_size, "--eval-every", &every, "--compute", "cpu"]);
    command.args(["--seed", "1", "--fresh", "--poses", poses]);
    let out = command.output()?;
    ensure!(out.status.success(), "{command:?}: {}", String::from_utf8_lossy(&out.stderr));
    serde_json::from_slice(&fs::read(folder.join("out").join("report.json"))?).context("no report")
}
