//! What a mission's global model loses where uploads break off, after the aggregator has taught it (MAS).
//!
//! `cargo bench -p cosurf-tests --bench broken_off -- --help`

use std::fs;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use clap::Parser;
use cosurf_aggregator::merge::{Locals, MergeError, MergeSettings, fill_in, merge};
use cosurf_engine::{Renderer, base_of};
use cosurf_link::{FirstLayer, Model, body_to_model, model_to_body, part_to_model};
use cosurf_scene::metrics::psnr;
use cosurf_scene::{Camera, Dataset, Picture, Splats, ply};

/// Parts of the bytes that arrive.
const PARTS: [f64; 4] = [0.2, 0.4, 0.6, 0.8];
/// Threads to merge and render with.
const THREADS: usize = 2;

/// The worth of global models when the uploads of the first agent, or of all, break off, a table on standard output.
#[derive(Parser)]
struct Arguments {
    /// The dataset of the mission
    data: PathBuf,
    /// Folders of its agents
    #[arg(required = true)]
    agents: Vec<PathBuf>,
    /// Epochs of teaching
    #[arg(long, value_name = "N", default_value_t = 5)]
    epochs: u32,
    /// What cargo says to every bench
    #[arg(long, hide = true)]
    bench: bool,
}

struct InMemory(Vec<Model>);

impl Locals for InMemory {
    fn count(&self) -> usize {
        self.0.len()
    }

    fn load(&self, index: usize) -> Result<Model, MergeError> {
        Ok(self.0[index].clone())
    }
}

fn main() -> Result<()> {
    let Arguments { data, agents, epochs, .. } = Arguments::parse();
    let bodies = agents.iter().map(|agent| body(agent)).collect::<Result<Vec<_>>>()?;
    let whole = bodies.iter().map(|body| body_to_model(body)).collect::<Result<Vec<_>, _>>()?;
    let size_px = whole[0].cameras[0].size_px;
    let views = held_out(&Dataset::open(&data)?, size_px)?;
    let settings = MergeSettings { epochs, ..MergeSettings::default() };
    let merged = |models: Vec<Model>| -> Result<Model> {
        Ok(merge(&InMemory(models), &settings, THREADS, &mut |_| ControlFlow::Continue(()))?.model)
    };
    let worth = |model: &Model| mean_psnr(&model.splats, &views);
    let all = worth(&merged(whole.clone())?);
    println!("all bytes of all: PSNR {all:.2} dB");
    let others = merged(whole[1..].to_vec())?;
    println!("without the first: {:.2} dB lost", all - worth(&others));
    println!("| first bytes | of one, lost dB | of all, lost dB |");
    println!("|---|---|---|");
    for part in PARTS {
        let cut = |body: &Vec<u8>| {
            let end = (part * body.len() as f64) as usize;
            part_to_model(body, |range| range.end <= end)?.context("nothing has arrived")
        };
        let one = fill_in(others.clone(), &cut(&bodies[0])?);
        let every = merged(bodies.iter().map(cut).collect::<Result<_>>()?)?;
        println!("| {:.0} % | {:.2} | {:.2} |", 100.0 * part, all - worth(&one), all - worth(&every));
    }
    Ok(())
}

/// An agent's model as it sends it.
fn body(agent: &Path) -> Result<Vec<u8>> {
    let splats = ply::read(&agent.join("model.ply"))?;
    let cameras: Vec<Camera> = serde_json::from_slice(&fs::read(agent.join("cameras.json"))?)?;
    let base = base_of(&splats, &cameras, THREADS, usize::MAX, |_, _| ()).context("a model too small")?;
    Ok(model_to_body(&splats, &cameras, FirstLayer::Base(&base))?)
}

fn held_out(dataset: &Dataset, size_px: [u32; 2]) -> Result<Vec<(Camera, Vec<f32>)>> {
    let (_, held_out) = dataset.split(8);
    let view = |i: &usize| {
        let camera = dataset.views[*i].camera.resized(size_px);
        Ok((camera, Picture::read_fitted(&dataset.views[*i].path, size_px)?.to_unit()))
    };
    held_out.iter().map(view).collect()
}

fn mean_psnr(splats: &Splats, views: &[(Camera, Vec<f32>)]) -> f64 {
    let mut renderer = Renderer::new(splats, THREADS);
    let one = |(camera, truth): &(Camera, Vec<f32>)| {
        let rgb: Vec<f32> = renderer.render(camera).rgb.iter().map(|v| v.clamp(0.0, 1.0)).collect();
        psnr(&rgb, truth)
    };
    views.iter().map(one).sum::<f64>() / views.len() as f64
}
