//! Measures whether a merge leaves seams where its tiles meet. A mission is merged twice, the second time moved over the
//! ground, so that the borders of tiles lie elsewhere. Pixels beside a border of one merge are compared with the same
//! pixels of the other one.
//!
//! `cargo bench -p cosurf-tests --bench seams -- --help`

mod held_out;
mod mission;

use std::env::temp_dir;
use std::ops::ControlFlow;

use anyhow::{Result, ensure};
use clap::Parser;
use cosurf_aggregator::gate::Similarity;
use cosurf_aggregator::merge::{InMemory, MergeSettings, Merged, Resources, Tiles, merge};
use cosurf_engine::Rendering;
use cosurf_link::Model;
use cosurf_scene::{Camera, Dataset};
use cosurf_tests::results::{Better, Column, Measurement, Tolerance};
use glam::{DVec2, DVec3};
use held_out::{HeldOut, THREADS};
use mission::Mission;

/// A pixel lies beside a border if it is nearer than so many pixels, measured on the ground.
const BESIDE_PX: f64 = 4.0;
/// By how much the second merge is moved along each axis, as a share of the width of the cameras' flights.
const MOVED: f64 = 0.137;

/// Measure whether a merge leaves seams where its tiles meet. Prints a table, and writes JSON to target/results.
#[derive(Parser)]
struct Arguments {
    #[command(flatten)]
    mission: Mission,
    /// Axis of the world that is vertical: 0, 1 or 2
    #[arg(long, value_name = "AXIS", default_value_t = 2)]
    vertical: usize,
}

fn main() -> Result<()> {
    let Arguments { mission, vertical } = Arguments::parse();
    let models = mission.models()?;
    ensure!(models.iter().all(|model| !model.cameras.is_empty()), "a model has no cameras");
    let size_px = models[0].cameras[0].size_px;
    let views = HeldOut::read(&Dataset::open(&mission.data)?, |camera| camera.resized(size_px))?;
    let by = MOVED * width(&models) * DVec3::ONE;
    let merges = [DVec3::ZERO, by].map(|by| Tiled::merge(&models, by, vertical));
    let [here, moved] = merges.map(|merged| merged.map(|its| (views.render(&its.model.splats), its)));
    let (here, moved) = (here?, moved?);
    let mut tally = Tally::default();
    for (i, (camera, photograph)) in views.0.iter().enumerate() {
        tally.add(camera, photograph, [(&here.0[i], &here.1), (&moved.0[i], &moved.1)]);
    }
    let mut measurement = Measurement::start("seams", &columns());
    let [here, moved] = [here, moved].map(|(renderings, _)| views.psnr(&renderings));
    let whole = [Some(100.0), Some(here), Some(moved), None, None];
    measurement.row(&format!("{}: whole views", mission.name), &whole);
    for (place, sums) in [("beside borders", tally.beside), ("elsewhere", tally.elsewhere)] {
        measurement.row(&format!("{}: {place}", mission.name), &sums.figures(tally.pixels));
    }
    measurement.finish()?;
    Ok(())
}

fn columns() -> [Column; 5] {
    [
        Column::new("pixels", "%", 1),
        Column::psnr("PSNR"),
        Column::new("PSNR with borders elsewhere", "dB", 2),
        Column::new("lost", "dB", 2).guarded(Better::Lower, Tolerance::Absolute(0.1)),
        Column::error("depths differ", "%", 3),
    ]
}

/// Width of the box around all cameras, along the longest axis.
fn width(models: &[Model]) -> f64 {
    let places =
        || models.iter().flat_map(|model| &model.cameras).map(|camera| camera.cam_from_world.center());
    (places().fold(DVec3::NEG_INFINITY, DVec3::max) - places().fold(DVec3::INFINITY, DVec3::min))
        .max_element()
}

/// A merged model and the rectangles of its tiles.
struct Tiled {
    model: Model,
    vertical: usize,
    /// The smallest rectangle around the splats of each tile: its two corners.
    tiles: Vec<[DVec2; 2]>,
}

impl Tiled {
    /// Merges the models after moving them, and moves the result back.
    fn merge(models: &[Model], by: DVec3, vertical: usize) -> Result<Self> {
        let shift = |translation: DVec3| Similarity { translation, ..Similarity::IDENTITY };
        let moved = InMemory(models.iter().map(|model| shift(by).model(model)).collect());
        let resources = Resources { scratch: &temp_dir(), tiles: Tiles::Forgotten, threads: THREADS };
        let Merged { model, tiles, .. } =
            merge(&moved, &MergeSettings::default(), resources, &mut |_| ControlFlow::Continue(()))?;
        let mut result = Self { model: shift(-by).model(&model), vertical, tiles: Vec::new() };
        let mut means = result.model.splats.means.iter();
        for tile in tiles {
            let places = means
                .by_ref()
                .take(tile.splats)
                .map(|mean| horizontal(vertical, DVec3::from(mean.map(f64::from))));
            let none = (DVec2::INFINITY, DVec2::NEG_INFINITY);
            let (low, high) = places.fold(none, |(low, high), place| (low.min(place), high.max(place)));
            result.tiles.push([low, high]);
        }
        Ok(result)
    }

    /// Distance from a place on the ground to the second nearest tile: to the nearest border of the tile that it lies
    /// in, unless nothing lies beyond.
    fn to_border(&self, place: DVec3) -> f64 {
        let place = horizontal(self.vertical, place);
        let distance = |[low, high]: &[DVec2; 2]| place.distance(place.clamp(*low, *high));
        let mut nearest = [f64::INFINITY; 2];
        for distance in self.tiles.iter().map(distance) {
            nearest = [nearest[0].min(distance), nearest[1].min(distance.max(nearest[0]))];
        }
        nearest[1]
    }
}

fn horizontal(vertical: usize, place: DVec3) -> DVec2 {
    DVec2::new(place[(vertical + 1) % 3], place[(vertical + 2) % 3])
}

/// What the pixels of all views sum up to.
#[derive(Default)]
struct Tally {
    pixels: usize,
    /// Pixels beside a border of one of the merges.
    beside: Sums,
    /// Pixels far from all borders.
    elsewhere: Sums,
}

impl Tally {
    /// Compares both merges with the photograph of a view.
    fn add(&mut self, camera: &Camera, photograph: &[f32], merges: [(&Rendering, &Tiled); 2]) {
        let width = camera.size_px[0] as usize;
        for (i, rgb) in photograph.chunks_exact(3).enumerate() {
            let p_px = DVec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
            let depths = merges.map(|(rendering, _)| f64::from(rendering.depth[i]));
            if depths.contains(&0.0) {
                continue; // no surface
            }
            let is_beside = [0, 1].map(|k| {
                let near = BESIDE_PX * depths[k] / camera.focal_px.x;
                merges[k].1.to_border(camera.unproject(p_px, depths[k])) < near
            });
            let errors = merges.map(|(rendering, _)| error(&rendering.rgb[3 * i..][..3], rgb));
            let depth = 2.0 * (depths[0] - depths[1]).abs() / (depths[0] + depths[1]);
            self.pixels += 1;
            match is_beside {
                [true, false] => self.beside.add(errors, depth),
                [false, true] => self.beside.add([errors[1], errors[0]], depth),
                [false, false] => self.elsewhere.add(errors, depth),
                [true, true] => {}
            }
        }
    }
}

/// Squared error of a pixel, summed over its three channels.
fn error(rgb: &[f32], photograph: &[f32]) -> f64 {
    rgb.iter().zip(photograph).map(|(a, b)| f64::from(a.clamp(0.0, 1.0) - b).powi(2)).sum()
}

#[derive(Default)]
struct Sums {
    pixels: usize,
    /// Squared errors of the merge with a border here, and of the other one.
    errors: [f64; 2],
    /// Differences of the depths of both merges, as shares of the depth.
    depths: f64,
}

impl Sums {
    fn add(&mut self, errors: [f64; 2], depth: f64) {
        self.pixels += 1;
        self.depths += depth;
        (0..2).for_each(|k| self.errors[k] += errors[k]);
    }

    fn figures(&self, pixels: usize) -> [Option<f64>; 5] {
        let count = self.pixels as f64;
        let [here, other] = self.errors.map(|sum| -10.0 * (sum / (3.0 * count)).log10());
        let share = 100.0 * count / pixels as f64;
        [share, here, other, other - here, 100.0 * self.depths / count].map(Some)
    }
}
