//! Measures the PSNR that a mission's global model, merged with distillation (MAS), loses when uploads break off.
//!
//! `cargo bench -p cosurf-tests --bench broken_off -- --help`

mod held_out;
mod mission;

use std::env::temp_dir;
use std::ops::ControlFlow;

use anyhow::{Context, Result};
use clap::Parser;
use cosurf_aggregator::merge::{InMemory, MergeSettings, Resources, Tiles, fill_in, merge};
use cosurf_engine::base_of;
use cosurf_link::{FirstLayer, Model, body_to_model, model_to_body, part_to_model};
use cosurf_scene::{Dataset, LocalFrame};
use cosurf_tests::results::{Better, Column, Measurement, Tolerance};
use held_out::{HeldOut, THREADS};
use mission::Mission;

/// The measured cases: the share of a body's bytes that arrives before the upload breaks off.
const PARTS: [f64; 4] = [0.2, 0.4, 0.6, 0.8];

/// Measure the PSNR that the global model loses if the upload of the first agent breaks off, or the uploads of all
/// agents. Prints a table, and writes JSON to target/results.
#[derive(Parser)]
struct Arguments {
    #[command(flatten)]
    mission: Mission,
    /// Epochs of distillation
    #[arg(long, value_name = "N", default_value_t = MergeSettings::default().epochs)]
    epochs: u32,
}

fn main() -> Result<()> {
    let Arguments { mission, epochs } = Arguments::parse();
    let bodies = mission.models()?.iter().map(body).collect::<Result<Vec<_>>>()?;
    let whole =
        bodies.iter().map(|body| body_to_model(body, &LocalFrame::WORLD)).collect::<Result<Vec<_>, _>>()?;
    let size_px = whole[0].cameras.first().context("the first model has no cameras")?.size_px;
    let views = HeldOut::read(&Dataset::open(&mission.data)?, |camera| camera.resized(size_px))?;
    let settings = MergeSettings { epochs, ..MergeSettings::default() };
    let merged = |models: Vec<Model>| -> Result<Model> {
        Ok(merge(
            &InMemory(models),
            &settings,
            Resources { scratch: &temp_dir(), tiles: Tiles::Forgotten, threads: THREADS },
            &mut |_| ControlFlow::Continue(()),
        )?
        .model)
    };
    let psnr = |model: &Model| views.psnr(&views.render(&model.splats));
    let all = psnr(&merged(whole.clone())?);
    let others = merged(whole[1..].to_vec())?;
    let mut of_one = vec![Some(all), Some(all - psnr(&others))];
    let mut of_all = vec![Some(all), None];
    for part in PARTS {
        let cut = |body: &Vec<u8>| {
            let end = (part * body.len() as f64) as usize;
            part_to_model(body, |range| range.end <= end, &LocalFrame::WORLD)?.context("no splat has arrived")
        };
        of_one.push(Some(all - psnr(&fill_in(others.clone(), &cut(&bodies[0])?))));
        of_all.push(Some(all - psnr(&merged(bodies.iter().map(cut).collect::<Result<_>>()?)?)));
    }
    let mut measurement = Measurement::start("broken_off", &columns());
    measurement.row(&format!("of one agent, {}", mission.name), &of_one);
    measurement.row(&format!("of all agents, {}", mission.name), &of_all);
    measurement.finish()?;
    Ok(())
}

fn columns() -> Vec<Column> {
    let lost = |name| Column::new(name, "dB lost", 2).guarded(Better::Lower, Tolerance::Absolute(0.3));
    let parts = ["nothing", "20 %", "40 %", "60 %", "80 %"].map(lost);
    [Column::psnr("all arrived")].into_iter().chain(parts).collect()
}

/// Encodes an agent's model as the body that the agent would upload.
fn body(Model { splats, cameras }: &Model) -> Result<Vec<u8>> {
    let base = base_of(splats, cameras, THREADS, usize::MAX, |_, _| ()).context("a model too small")?;
    Ok(model_to_body(splats, cameras, &LocalFrame::WORLD, FirstLayer::Base(&base))?)
}
