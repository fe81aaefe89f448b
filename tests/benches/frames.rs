//! Measures the PSNR that a mission's global model loses if models arrive in frames that are not exactly right.
//!
//! `cargo bench -p cosurf-tests --bench frames -- --help`

mod agents;
mod dice;
mod held_out;

use std::ops::ControlFlow;
use std::path::PathBuf;

use agents::InMemory;
use anyhow::{Context, Result};
use clap::Parser;
use cosurf_aggregator::gate::{Similarity, admit};
use cosurf_aggregator::merge::{Locals, MergeSettings, merge};
use cosurf_link::Model;
use cosurf_scene::{Camera, Dataset};
use cosurf_tests::results::{Better, Column, Measurement, Tolerance};
use dice::Dice;
use glam::{DQuat, DVec3};
use held_out::{HeldOut, THREADS};

/// Ways in which one model can lie wrong: name, distance in metres, rotation in degrees, and scale.
const WRONG: [(&str, f64, f64, f64); 10] = [
    ("moved by 0.25 m", 0.25, 0.0, 1.0),
    ("moved by 0.5 m", 0.5, 0.0, 1.0),
    ("moved by 1 m", 1.0, 0.0, 1.0),
    ("moved by 2 m", 2.0, 0.0, 1.0),
    ("moved by 5 m", 5.0, 0.0, 1.0),
    ("turned by 0.2°", 0.0, 0.2, 1.0),
    ("turned by 0.5°", 0.0, 0.5, 1.0),
    ("turned by 1°", 0.0, 1.0, 1.0),
    ("0.5 % too large", 0.0, 0.0, 1.005),
    ("2 % too large", 0.0, 0.0, 1.02),
];
/// Errors of every model when all models lie wrong: metres, degrees, share of the scale.
const EVERYWHERE: (f64, f64, f64) = (1.0, 0.5, 0.01);

/// Measure the PSNR that the global model loses if one agent's model, or every agent's model, lies in a wrong frame.
/// Prints a table, and writes JSON to target/results.
#[derive(Parser)]
struct Arguments {
    /// Folder of the mission's dataset
    data: PathBuf,
    /// Output folders of the mission's agents
    #[arg(required = true)]
    agents: Vec<PathBuf>,
    /// Name of the dataset in the results
    #[arg(long, default_value = "mission")]
    name: String,
    /// Number of cases in which every model lies wrong
    #[arg(long, value_name = "N", default_value_t = 4)]
    seeds: u64,
    /// Leave the models where they are
    #[arg(long)]
    no_refine: bool,
    /// Measure only cases whose names contain this text
    #[arg(long, value_name = "TEXT", default_value = "")]
    only: String,
    /// Passed by cargo to every bench
    #[arg(long, hide = true)]
    bench: bool,
}

fn main() -> Result<()> {
    let arguments = Arguments::parse();
    let models = arguments.agents.iter().map(|agent| agents::read(agent)).collect::<Result<Vec<_>>>()?;
    let size_px = models[0].cameras.first().context("a model without cameras")?.size_px;
    let views = HeldOut::read(&Dataset::open(&arguments.data)?, |camera| camera.resized(size_px))?;
    let settings = MergeSettings { refine: !arguments.no_refine, ..MergeSettings::default() };
    let psnr = |models: Vec<Model>, truth: Option<&[Model]>| -> Result<f64> {
        let model = merged(models, &settings, truth)?;
        Ok(views.psnr(&views.render(&model.splats)))
    };
    let lost = Column::new("lost", "dB", 2).guarded(Better::Lower, Tolerance::Absolute(0.1));
    let mut measurement = Measurement::start("frames", &[Column::psnr("PSNR"), lost]);
    let right = psnr(models.clone(), None)?;
    let mut row = |case: &str, psnr: f64| {
        measurement.row(&format!("{}: {case}", arguments.name), &[Some(psnr), Some(right - psnr)]);
    };
    row("as trained", right);
    for (i, (case, by_m, turn_deg, scale)) in WRONG.into_iter().enumerate() {
        if case.contains(&arguments.only) {
            let mut models = models.clone();
            let wrong = i % models.len();
            models[wrong] = displaced(&models[wrong], &mut Dice(i as u64), by_m, turn_deg, scale);
            row(&format!("one model {case}"), psnr(models, None)?);
        }
    }
    for seed in 0..arguments.seeds {
        let mut dice = Dice(1000 + seed);
        let (by_m, turn_deg, scale) = EVERYWHERE;
        let displaced = models.iter().map(|model| {
            let scale = if dice.unit() < 0.5 { 1.0 - scale } else { 1.0 + scale };
            displaced(model, &mut dice, by_m, turn_deg, scale)
        });
        let displaced = displaced.collect();
        row(&format!("every model off, seed {seed}"), psnr(displaced, Some(&models))?);
    }
    measurement.finish()?;
    Ok(())
}

/// The global model. With `truth`, the models in their right places, it is laid on them by one similarity.
fn merged(models: Vec<Model>, settings: &MergeSettings, truth: Option<&[Model]>) -> Result<Model> {
    let locals = InMemory(models);
    let admitted = admit(&locals, settings.into(), THREADS, &|| false)?;
    for fit in admitted.fits() {
        println!("  {fit:.2?}");
    }
    let model = merge(&admitted, settings, THREADS, &mut |_| ControlFlow::Continue(()))?.model;
    let Some(truth) = truth else { return Ok(model) };
    let right = (0..admitted.count()).flat_map(|i| &truth[admitted.place(i).local].cameras);
    let eye = |camera: &Camera| camera.cam_from_world.center();
    let (from, to): (Vec<DVec3>, Vec<DVec3>) =
        model.cameras.iter().zip(right).map(|(a, b)| (eye(a), eye(b))).unzip();
    Ok(Similarity::between(&from, &to).context("too few cameras")?.model(&model))
}

/// The model turned and scaled about the middle of its flight, then moved; axis and direction are random.
fn displaced(model: &Model, dice: &mut Dice, by_m: f64, turn_deg: f64, scale: f64) -> Model {
    let eyes = model.cameras.iter().map(|camera| camera.cam_from_world.center());
    let middle = eyes.sum::<DVec3>() / model.cameras.len().max(1) as f64;
    let rotation = DQuat::from_axis_angle(dice.direction(), turn_deg.to_radians());
    let translation = by_m * dice.direction() + middle - scale * (rotation * middle);
    Similarity { scale, rotation, translation }.model(model)
}
