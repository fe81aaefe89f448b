//! Measures what a mission's global model loses if models arrive in frames that are not exactly right.
//!
//! `cargo bench -p cosurf-tests --bench frames -- --help`

mod held_out;
mod mission;
mod surface;
mod wrong;

use std::env::temp_dir;
use std::ops::ControlFlow;

use anyhow::{Context, Result};
use clap::Parser;
use cosurf_aggregator::gate::{Workspace, admit};
use cosurf_aggregator::merge::{InMemory, Locals, MergeSettings, Resources, Tiles, merge};
use cosurf_link::Model;
use cosurf_scene::{Camera, Dataset, Mesh};
use cosurf_tests::datasets::true_surface;
use cosurf_tests::dice::Dice;
use cosurf_tests::results::{Better, Column, Measurement, Tolerance};
use held_out::{HeldOut, THREADS};
use mission::Mission;
use surface::f_score;
use wrong::{WRONG, between, displaced};

/// Errors of every model when all models lie wrong: metres, degrees, share of the scale.
const EVERYWHERE: (f64, f64, f64) = (1.0, 0.5, 0.01);

/// Measure the PSNR that the global model loses if one agent's model, or every agent's model, lies in a wrong frame; and
/// the F-score of its mesh, if the dataset has a true surface (in gt). Prints a table, and writes JSON to
/// target/results.
#[derive(Parser)]
struct Arguments {
    #[command(flatten)]
    mission: Mission,
    /// Number of cases in which every model lies wrong
    #[arg(long, value_name = "N", default_value_t = 4)]
    seeds: u64,
    /// Leave the models where they are
    #[arg(long)]
    no_refine: bool,
    /// Of the cases with one wrong model, measure only those whose names contain this text
    #[arg(long, value_name = "TEXT", default_value = "")]
    only: String,
    /// Largest distance from the true surface that counts as correct, metres
    #[arg(long, value_name = "M", default_value_t = 0.5)]
    threshold: f64,
}

fn main() -> Result<()> {
    let Arguments { mission, seeds, no_refine, only, threshold } = Arguments::parse();
    let models = mission.models()?;
    let settings = MergeSettings { refine: !no_refine, ..MergeSettings::default() };
    let size_px = models[0].cameras.first().context("the first model has no cameras")?.size_px;
    let dataset = Dataset::open(&mission.data)?;
    let views = HeldOut::read(&dataset, |camera| camera.resized(size_px))?;
    let yardstick = Yardstick {
        views,
        cameras: dataset.views.iter().map(|view| view.camera.resized(size_px)).collect(),
        truth: true_surface(&mission.data).map(|file| Mesh::read(&file)).transpose()?,
        threshold_m: threshold,
        settings,
    };
    let mut measurement = Measurement::start("frames", &columns());
    let right = yardstick.quality(models.clone(), None)?;
    let mut row = |case: &str, found: Quality| {
        let surface_lost = right.f_score.zip(found.f_score).map(|(right, found)| right - found);
        let lost = right.psnr - found.psnr;
        let values = [Some(found.psnr), Some(lost), found.f_score, surface_lost];
        measurement.row(&format!("{}: {case}", mission.name), &values);
    };
    row("as trained", right);
    for (i, (case, by_m, turn_deg, scale)) in WRONG.into_iter().enumerate() {
        if case.contains(&only) {
            let mut models = models.clone();
            let wrong = i % models.len();
            models[wrong] = displaced(&models[wrong], &mut Dice(i as u64), by_m, turn_deg, scale);
            row(&format!("one model {case}"), yardstick.quality(models, None)?);
        }
    }
    let mut worst: Option<Quality> = None;
    for seed in 0..seeds {
        let mut dice = Dice(1000 + seed);
        let (by_m, turn_deg, scale) = EVERYWHERE;
        let displaced = models.iter().map(|model| {
            let scale = if dice.coin() { 1.0 - scale } else { 1.0 + scale };
            displaced(model, &mut dice, by_m, turn_deg, scale)
        });
        let found = yardstick.quality(displaced.collect(), Some(&models))?;
        println!("  every model off, seed {seed}: {found:.3?}");
        worst = Some(worst.map_or(found, |worst| worst.worse(found)));
    }
    if let Some(worst) = worst {
        row(&format!("every model off, the worst of {seeds} seeds"), worst);
    }
    measurement.finish()?;
    Ok(())
}

fn columns() -> [Column; 4] {
    let lost = Column::new("lost", "dB", 2).guarded(Better::Lower, Tolerance::Absolute(0.1));
    let surface_lost = Column::new("F-score lost", "", 3).guarded(Better::Lower, Tolerance::Absolute(0.005));
    [Column::psnr("PSNR"), lost, Column::f_score(), surface_lost]
}

/// The quality of a global model.
#[derive(Clone, Copy, Debug)]
struct Quality {
    /// On the held-out views, dB.
    psnr: f64,
    /// Of the mesh, 0..=1; `None` if the true surface is not known.
    f_score: Option<f64>,
}

impl Quality {
    /// The lower figures of both.
    fn worse(self, other: Self) -> Self {
        let f_score = self.f_score.zip(other.f_score).map(|(one, other)| one.min(other));
        Self { psnr: self.psnr.min(other.psnr), f_score }
    }
}

/// What global models are compared with.
struct Yardstick {
    views: HeldOut,
    /// The cameras to make meshes from.
    cameras: Vec<Camera>,
    truth: Option<Mesh>,
    threshold_m: f64,
    settings: MergeSettings,
}

impl Yardstick {
    /// The quality of the global model. With `truth`, the models in their right places, the global model is first laid
    /// on them by one similarity.
    fn quality(&self, models: Vec<Model>, truth: Option<&[Model]>) -> Result<Quality> {
        let splats = merged(models, &self.settings, truth)?.splats;
        let psnr = self.views.psnr(&self.views.render(&splats));
        let score = |truth| f_score(splats, &self.cameras, truth, self.threshold_m);
        let f_score = self.truth.as_ref().map(score).transpose()?;
        Ok(Quality { psnr, f_score })
    }
}

fn merged(models: Vec<Model>, settings: &MergeSettings, truth: Option<&[Model]>) -> Result<Model> {
    let locals = InMemory(models);
    let admitted = admit(&locals, settings.into(), Workspace::of(settings, &temp_dir(), THREADS), &|| false)?;
    let model = merge(
        &admitted,
        settings,
        Resources { scratch: &temp_dir(), tiles: Tiles::Forgotten, threads: THREADS },
        &mut |_| ControlFlow::Continue(()),
    )?
    .model;
    let Some(truth) = truth else { return Ok(model) };
    let right = (0..admitted.count()).map(|i| &truth[admitted.place(i).local]);
    Ok(between([&model], right).context("too few cameras")?.model(&model))
}
