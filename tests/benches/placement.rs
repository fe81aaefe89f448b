//! Measures how exactly the aggregator finds the places of models that arrive in wrong frames.
//!
//! `cargo bench -p cosurf-tests --bench placement -- --help`

mod mission;
mod wrong;

use std::env::temp_dir;
use std::thread::available_parallelism;
use std::time::Instant;

use anyhow::{Context, Result};
use clap::Parser;
use cosurf_aggregator::gate::{Frames, Workspace, admit};
use cosurf_aggregator::merge::{InMemory, Locals, MergeSettings};
use cosurf_engine::Renderer;
use cosurf_link::Model;
use cosurf_scene::{Camera, camera};
use cosurf_tests::dice::Dice;
use cosurf_tests::results::{Better, Column, Measurement, Tolerance};
use glam::DVec3;
use mission::Mission;
use wrong::{WRONG, about_its_middle, between, displaced, eyes};

/// The models are placed if their cameras are this close to their places ([`Case::error`]).
const PLACED_MAX: f64 = 0.0002;
/// From this error on, models are joined askew: as many pixels on the ground as the aggregator leaves uncorrected.
const ASKEW_PX: f64 = 0.25;
/// Range of the scales of frames of their own. The logarithms of all scales are equally likely.
const SCALES: [f64; 2] = [0.1, 10.0];
/// Largest distance between a model's place and its place in a frame of its own, metres, along each axis.
const AWAY_M: f64 = 10_000.0;

/// Measure where the aggregator places models that arrive in wrong frames: one of them displaced in ten ways, and each
/// in a frame of its own. After one similarity for all models, it compares their cameras with the right places. Prints
/// a table, and writes JSON to target/results.
#[derive(Parser)]
struct Arguments {
    #[command(flatten)]
    mission: Mission,
    /// Number of cases in which each model has a frame of its own
    #[arg(long, value_name = "N", default_value_t = 4)]
    seeds: u64,
}

fn main() -> Result<()> {
    let Arguments { mission, seeds } = Arguments::parse();
    let models = mission.models()?;
    let mut measurement = Measurement::start("placement", &columns());
    let askew = ASKEW_PX * pixel_m(&models)? / extent(&models.iter().collect::<Vec<_>>());
    let mut row = |case: &str, tally: &Tally| {
        measurement.row(&format!("{}: {case}", mission.name), &tally.figures(askew));
    };
    let mut displaced_ones = Tally::default();
    for (i, (case, by_m, turn_deg, scale)) in WRONG.into_iter().enumerate() {
        let mut given = models.clone();
        let wrong = i % models.len();
        given[wrong] = displaced(&models[wrong], &mut Dice(i as u64), by_m, turn_deg, scale);
        displaced_ones.note(&format!("one model {case}"), Case::measure(given, &models)?);
    }
    row("one model displaced", &displaced_ones);
    let mut own_frames = Tally::default();
    for seed in 0..seeds {
        let mut dice = Dice(2000 + seed);
        let given = models.iter().map(|model| in_its_own_frame(model, &mut dice)).collect();
        own_frames.note(&format!("own frames, seed {seed}"), Case::measure(given, &models)?);
    }
    row("each model in a frame of its own", &own_frames);
    measurement.finish()?;
    Ok(())
}

fn columns() -> [Column; 7] {
    let count = |name| Column::new(name, "cases", 0);
    let error = |name| Column::error(name, "% of the extent", 3);
    [
        count("measured"),
        count("placed within 0.02 %").guarded(Better::Higher, Tolerance::Relative(0.05)),
        count("kept out").guarded(Better::Lower, Tolerance::Absolute(2.0)),
        count("more than ¼ px off").guarded(Better::Lower, Tolerance::Absolute(0.0)),
        error("median"),
        error("largest"),
        Column::new("time", "s a case", 0),
    ]
}

/// The model in a random frame.
fn in_its_own_frame(model: &Model, dice: &mut Dice) -> Model {
    let rotation = dice.rotation();
    let [low, high] = SCALES.map(f64::ln);
    let scale = (low + (high - low) * dice.unit()).exp();
    let away = [(); 3].map(|()| AWAY_M * (2.0 * dice.unit() - 1.0));
    about_its_middle(model, scale, rotation, DVec3::from_array(away))
}

/// Where the aggregator has placed the models.
struct Case {
    /// Root mean square of the distances of all cameras from their places, as a share of the extent of all flights. The
    /// cameras of models that are kept out do not count.
    error: f64,
    /// The reason for each model that is kept out.
    kept_out: Vec<String>,
    seconds: f64,
}

impl Case {
    /// `right` has the models in their right places.
    fn measure(given: Vec<Model>, right: &[Model]) -> Result<Self> {
        let threads = available_parallelism()?.get();
        let frames = Frames { refine: true, vouched: false };
        let begun = Instant::now();
        let locals = InMemory(given);
        let admitted =
            admit(&locals, frames, Workspace::of(&MergeSettings::default(), &temp_dir(), threads), &|| {
                false
            })?;
        let seconds = begun.elapsed().as_secs_f64();
        let names: Vec<String> = (1..=right.len()).map(|i| format!("model {i}")).collect();
        let kept_out =
            admitted.kept_out(&names).map(|(i, reason)| format!("{} {reason}", names[i])).collect();
        let places = 0..admitted.count();
        let placed = places.clone().map(|i| Ok(admitted.load(i)?)).collect::<Result<Vec<Model>>>()?;
        let right: Vec<&Model> = places.map(|i| &right[admitted.place(i).local]).collect();
        let laid = between(&placed, right.iter().copied()).context("too few cameras")?;
        let pairs = eyes(&placed).into_iter().zip(eyes(right.iter().copied()));
        let squares_m2: Vec<f64> = pairs.map(|(a, b)| laid.apply(a).distance_squared(b)).collect();
        let error_m = (squares_m2.iter().sum::<f64>() / squares_m2.len().max(1) as f64).sqrt();
        Ok(Self { error: error_m / extent(&right), kept_out, seconds })
    }
}

/// Extent of all flights (3DGS), world units.
fn extent(models: &[&Model]) -> f64 {
    let cameras: Vec<Camera> = models.iter().flat_map(|model| &model.cameras).copied().collect();
    camera::extent(cameras.iter())
}

/// Width that a pixel covers on the ground, world units: the median over the models' first cameras.
fn pixel_m(models: &[Model]) -> Result<f64> {
    let width = |Model { splats, cameras }: &Model| {
        let camera = cameras.first().context("a model has no cameras")?;
        let mut depth = Renderer::new(splats, 1).render(camera).depth;
        Ok(f64::from(median(&mut depth).context("an empty picture")?) / camera.focal_px.x)
    };
    let mut widths = models.iter().map(width).collect::<Result<Vec<f64>>>()?;
    median(&mut widths).context("no models")
}

fn median<T: PartialOrd + Copy>(values: &mut [T]) -> Option<T> {
    values.sort_by(|a, b| a.partial_cmp(b).expect("no value is NaN"));
    values.get(values.len() / 2).copied()
}

/// The figures of several cases.
#[derive(Default)]
struct Tally(Vec<Case>);

impl Tally {
    /// Adds a case and prints it.
    fn note(&mut self, name: &str, case: Case) {
        println!("  {name}: {:.4} % of the extent, {:.1} s", 100.0 * case.error, case.seconds);
        case.kept_out.iter().for_each(|reason| println!("    kept out: {reason}"));
        self.0.push(case);
    }

    /// From the error `askew` on, models count as joined askew.
    fn figures(&self, askew: f64) -> [Option<f64>; 7] {
        let count = |is: &dyn Fn(&Case) -> bool| Some(self.0.iter().filter(|case| is(case)).count() as f64);
        let mut errors: Vec<f64> = self.0.iter().map(|case| 100.0 * case.error).collect();
        let middle = median(&mut errors);
        let seconds = self.0.iter().map(|case| case.seconds).sum::<f64>() / self.0.len().max(1) as f64;
        [
            Some(self.0.len() as f64),
            count(&|case| case.kept_out.is_empty() && case.error <= PLACED_MAX),
            count(&|case| !case.kept_out.is_empty()),
            count(&|case| case.error > askew),
            middle,
            errors.last().copied(),
            Some(seconds),
        ]
    }
}
