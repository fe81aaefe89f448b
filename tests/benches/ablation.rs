//! Shared code of the ablation benches. They compare trainings that differ in one setting. Each model is scored on
//! held-out views and against the true surface.
//!
//! The default dataset is `../shared/data/gt_boruszyn`, relative to the checkout. If it is missing, the benches use a
//! small synthetic city.

use std::path::{Path, PathBuf};
use std::thread::available_parallelism;
use std::time::Instant;

use anyhow::{Context, Result};
use clap::Parser;
use cosurf_agent::session::{Session, Split, TrainPlan};
use cosurf_aggregator::evaluate::{EvalOrder, EvalReport, Spread, evaluate_model};
use cosurf_engine::{DeviceChoice, PoseChoice, PruneSettings, SurfaceSettings};
use cosurf_scene::{Camera, LocalFrame, Mesh, Splats, ply};
use cosurf_tests::datasets::{default_dataset, true_surface};
use cosurf_tests::results::{Better, Column, Measurement};

use crate::surface::f_score;

const EVAL_EVERY: u32 = 8;

/// Compare settings of the training. Prints a table, and writes JSON to target/results.
#[derive(Parser)]
pub(crate) struct Arguments {
    /// Folder of a dataset with its true surface, gt/points.ply or gt/mesh.ply [default: gt_boruszyn or a city]
    #[arg(long, value_name = "DATA")]
    data: Option<PathBuf>,
    /// Shrink pictures until their long side is at most this many pixels
    #[arg(long, value_name = "PX", default_value_t = 240)]
    max_size: u32,
    /// Number of steps of each training
    #[arg(long, value_name = "N", default_value_t = 3000)]
    steps: u32,
    /// Largest distance from the true surface that counts as correct, metres
    #[arg(long, value_name = "M", default_value_t = 0.5)]
    threshold: f64,
    /// Passed by cargo to every bench
    #[arg(long, hide = true)]
    bench: bool,
}

/// A training to measure, with its settings.
pub(crate) struct Variant {
    pub(crate) name: String,
    pub(crate) surface: Option<SurfaceSettings>,
    pub(crate) prune: Option<PruneSettings>,
}

/// Trains and scores every variant, and writes the results under the name `name`. Times are relative to the first
/// variant.
pub(crate) fn compare(name: &str, variants: &[Variant]) -> Result<()> {
    let arguments = Arguments::parse();
    let folder = tempfile::tempdir()?;
    let data = arguments.data.clone().unwrap_or_else(|| default_dataset(folder.path()));
    let truth = truth(&data)?;
    println!(
        "{}, long side {} px, {} steps, threshold {} m\n",
        data.display(),
        arguments.max_size,
        arguments.steps,
        arguments.threshold
    );
    let mut measurement = Measurement::start(name, &columns());
    let mut first_s = None;
    for variant in variants {
        let trained = train(&arguments, &data, variant)?;
        let relative = trained.seconds / *first_s.get_or_insert(trained.seconds);
        let file = folder.path().join("model.ply");
        ply::write(&file, &trained.splats, &LocalFrame::WORLD)?;
        let eval = evaluate_model(&order(&arguments, &data, &file))?;
        let f_score = f_score(trained.splats, &trained.cameras, &truth, arguments.threshold);
        if let Err(error) = &f_score {
            eprintln!("{}: {error}", variant.name);
        }
        measurement.row(&variant.name, &figures(&eval, f_score.ok(), relative));
    }
    measurement.finish()?;
    Ok(())
}

fn columns() -> [Column; 8] {
    [
        Column::splats(),
        Column::psnr("PSNR"),
        Column::ssim(),
        Column::error("depth", "%", 2),
        Column::error("blended normals", "°", 1),
        Column::error("normals of the depth", "°", 1),
        Column::f_score(),
        Column::speed("time", "× the first", 2, Better::Lower),
    ]
}

fn truth(data: &Path) -> Result<Mesh> {
    let file =
        true_surface(data).with_context(|| format!("{} has no true surface in gt/", data.display()))?;
    Ok(Mesh::read(&file)?)
}

/// The result of a training.
struct Trained {
    splats: Splats,
    cameras: Vec<Camera>,
    seconds: f64,
}

fn train(arguments: &Arguments, data: &Path, variant: &Variant) -> Result<Trained> {
    let plan = TrainPlan {
        data: data.into(),
        split: Split::Every(EVAL_EVERY),
        steps: arguments.steps,
        seed: 0,
        memory_bytes: 8 << 30,
        max_size_px: arguments.max_size,
        device: DeviceChoice::Cpu,
        threads: threads(),
        surface: variant.surface,
        prune: variant.prune,
        exposure: false,
        poses: PoseChoice::Fixed,
        init: None,
        one_of_many: false,
    };
    let mut session = Session::start(&plan, None)?;
    let begun = Instant::now();
    while !session.trainer().is_done() {
        session.step()?;
    }
    let seconds = begun.elapsed().as_secs_f64();
    let cameras = session.cameras();
    Ok(Trained { splats: session.into_model()?.into_splats(), cameras, seconds })
}

fn threads() -> usize {
    available_parallelism().map_or(1, usize::from)
}

fn order(arguments: &Arguments, data: &Path, model: &Path) -> EvalOrder {
    EvalOrder {
        model: model.into(),
        data: data.into(),
        lpips: None,
        truth: None,
        eval_every: EVAL_EVERY,
        max_size_px: Some(arguments.max_size),
        align: false,
        threads: threads(),
    }
}

fn figures(eval: &EvalReport, f_score: Option<f64>, relative: f64) -> [Option<f64>; 8] {
    let surface = eval.mean.surface;
    let median = |error: Option<Spread>| error.map(|error| error.median);
    [
        Some(eval.splats as f64),
        Some(eval.mean.psnr),
        Some(eval.mean.ssim),
        median(surface.and_then(|surface| surface.depth_error_percent)),
        median(surface.and_then(|surface| surface.normal_error_deg)),
        median(surface.and_then(|surface| surface.depth_normal_error_deg)),
        f_score,
        Some(relative),
    ]
}
