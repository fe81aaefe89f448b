//! Trains a scene with the agent of an earlier version and with this one, and compares quality and time.
//!
//! `cargo bench -p cosurf-tests --bench earlier -- --help`

mod surface;

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::thread::available_parallelism;
use std::time::Instant;

use anyhow::{Result, ensure};
use clap::Parser;
use cosurf_aggregator::evaluate::{EvalOrder, EvalReport, evaluate_model};
use cosurf_scene::{Camera, Dataset, LocalFrame, Mesh, model};
use cosurf_tests::datasets::{default_dataset, true_surface};
use cosurf_tests::programs::program;
use cosurf_tests::results::{Better, Column, Measurement};

use surface::f_score;

/// Every eighth view is held out.
const EVAL_EVERY: u32 = 8;

/// Train with an earlier agent and with this one. Prints a table, and writes JSON to target/results.
#[derive(Parser)]
struct Arguments {
    /// The earlier version's cosurf-agent
    #[arg(long, value_name = "PROGRAM")]
    earlier: PathBuf,
    /// Steps of the earlier agent's trainings
    #[arg(long, value_name = "N", value_delimiter = ',', default_value = "3000")]
    earlier_steps: Vec<u32>,
    /// Steps of this agent's trainings
    #[arg(long, value_name = "N", value_delimiter = ',', default_value = "1500,3000")]
    steps: Vec<u32>,
    /// Folder of a dataset [default: gt_boruszyn or a city]
    #[arg(long, value_name = "DATA")]
    data: Option<PathBuf>,
    /// Name of the dataset, before the name of each row
    #[arg(long, value_name = "NAME", default_value = "gt_boruszyn")]
    name: String,
    /// Shrink pictures until their long side is at most this many pixels
    #[arg(long, value_name = "PX", default_value_t = 480)]
    max_size: u32,
    /// Largest distance from the true surface that counts as correct, metres
    #[arg(long, value_name = "M", default_value_t = 0.5)]
    threshold: f64,
    /// Passed by cargo to every bench
    #[arg(long, hide = true)]
    bench: bool,
}

fn main() -> Result<()> {
    let arguments = Arguments::parse();
    let folder = tempfile::tempdir()?;
    let data = arguments.data.clone().unwrap_or_else(|| default_dataset(folder.path()));
    let scorer = Scorer::new(&arguments, data.clone())?;
    let mut measurement = Measurement::start("earlier", &columns());
    let ours = program("cosurf-agent");
    let earlier = arguments.earlier_steps.iter().map(|steps| ("earlier", &arguments.earlier, *steps));
    let trainings = earlier.chain(arguments.steps.iter().map(|steps| ("now", &ours, *steps)));
    for (i, (version, agent, steps)) in trainings.enumerate() {
        let out = folder.path().join(i.to_string());
        let seconds = train(agent, &data, steps, arguments.max_size, &out)?;
        let row = format!("{}: {version}, {steps} steps", arguments.name);
        measurement.row(&row, &scorer.figures(&out.join("model.ply"), seconds)?);
    }
    measurement.finish()?;
    Ok(())
}

fn columns() -> [Column; 7] {
    [
        Column::speed("time", "s", 0, Better::Lower),
        Column::splats(),
        Column::psnr("PSNR"),
        Column::ssim(),
        Column::f_score(),
        Column::error("normals of the depth", "°", 1),
        Column::error("depth", "%", 2),
    ]
}

/// Runs an agent's `train` with its default options. Returns the wall time of the process, seconds.
fn train(agent: &Path, data: &Path, steps: u32, max_size: u32, out: &Path) -> Result<f64> {
    let mut command = Command::new(agent);
    command.arg("train").arg(data).arg("--out").arg(out);
    command.args(["--steps", &steps.to_string(), "--max-size", &max_size.to_string()]);
    command.args(["--eval-every", &EVAL_EVERY.to_string()]).stdin(Stdio::null());
    let begun = Instant::now();
    let output = command.output()?;
    ensure!(output.status.success(), "{command:?}: {}", String::from_utf8_lossy(&output.stderr));
    Ok(begun.elapsed().as_secs_f64())
}

/// Scores the models of both versions in the same way.
struct Scorer {
    data: PathBuf,
    cameras: Vec<Camera>,
    truth: Option<Mesh>,
    max_size: u32,
    threshold: f64,
}

impl Scorer {
    fn new(arguments: &Arguments, data: PathBuf) -> Result<Self> {
        let dataset = Dataset::open(&data)?;
        let fitted = |i: &usize| dataset.views[*i].camera.fitted(arguments.max_size);
        let cameras = dataset.split(EVAL_EVERY).0.iter().map(fitted).collect();
        let truth = true_surface(&data).map(|file| Mesh::read(&file)).transpose()?;
        let (max_size, threshold) = (arguments.max_size, arguments.threshold);
        Ok(Self { data, cameras, truth, max_size, threshold })
    }

    fn figures(&self, file: &Path, seconds: f64) -> Result<[Option<f64>; 7]> {
        let EvalReport { splats, mean, .. } = evaluate_model(&self.order(file))?;
        let score = |truth| {
            let splats = model::read(file, &LocalFrame::WORLD)?;
            f_score(splats, &self.cameras, truth, self.threshold)
        };
        let f_score = self.truth.as_ref().map(score).transpose()?;
        let surface = mean.surface;
        let normals = surface.and_then(|surface| surface.depth_normal_error_deg).map(|error| error.median);
        let depth = surface.and_then(|surface| surface.depth_error_percent).map(|error| error.median);
        Ok([Some(seconds), Some(splats as f64), Some(mean.psnr), Some(mean.ssim), f_score, normals, depth])
    }

    fn order(&self, model: &Path) -> EvalOrder {
        EvalOrder {
            model: model.into(),
            data: self.data.clone(),
            lpips: None,
            truth: None,
            eval_every: EVAL_EVERY,
            max_size_px: Some(self.max_size),
            align: false,
            threads: available_parallelism().map_or(1, usize::from),
        }
    }
}
