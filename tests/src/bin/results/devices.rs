//! Compares the quality of the same training and the same merge on the CPU and on the GPU.

use std::path::Path;

use anyhow::{Context, Result};
use cosurf_tests::results::{Column, Measurement, Results};
use serde_json::Value;
use tempfile::TempDir;

use crate::commands::{agents, build, dataset, evaluate, merge, mission, train};

const OPTIONS: [&str; 4] = ["--max-size", "160", "--steps", "500"];
const DEVICES: [&str; 2] = ["cpu", "gpu"];
const SEEDS: [&str; 4] = ["0", "1", "2", "3"];
/// Every eighth view by name is held out.
const HELD_OUT: usize = 8;

/// Mean PSNR over training views and over held-out views, dB.
struct Psnr {
    training: f64,
    held_out: f64,
}

/// Trains Boruszyn with four seeds and merges two models of Caliterra, on each device.
pub(crate) fn devices(folder: &TempDir) -> Result<Results> {
    build()?;
    let out = |name: &str| folder.path().join(name);
    let boruszyn = dataset("real_boruszyn")?;
    let mut trained = Vec::new();
    for device in DEVICES {
        let of_seed = |seed: &&str| {
            let options = [&OPTIONS[..], &["--device", device, "--seed", seed]].concat();
            let out = out(&format!("{device}-{seed}"));
            train(&boruszyn, &options, &out)?;
            psnr(&out, &boruszyn)
        };
        trained.push(SEEDS.iter().map(of_seed).collect::<Result<Vec<Psnr>>>()?);
    }
    let name = device_name(&out("gpu-0"))?;
    let columns = [Column::psnr("CPU"), Column::psnr(&format!("GPU ({name})"))];
    let mut measurement = Measurement::start("devices", &columns);
    for (views, is_held_out) in [("training", false), ("held-out", true)] {
        let psnrs = trained.iter().map(|runs| {
            let of_run = |psnr: &Psnr| if is_held_out { psnr.held_out } else { psnr.training };
            runs.iter().map(of_run).collect::<Vec<f64>>()
        });
        let psnrs: Vec<_> = psnrs.collect();
        let mut row = |what, over: fn(&[f64]) -> Option<f64>| {
            let figures: Vec<_> = psnrs.iter().map(|psnrs| over(psnrs)).collect();
            measurement.row(&format!("{views} views of Boruszyn, {what} of four seeds"), &figures);
        };
        row("mean", |values| Some(values.iter().sum::<f64>() / values.len() as f64));
        row("lowest", |values| values.iter().copied().reduce(f64::min));
        row("highest", |values| values.iter().copied().reduce(f64::max));
    }
    measurement.row("two models of Caliterra merged, held-out views", &merged(folder)?);
    Ok(measurement.finish()?)
}

/// Mean PSNR over held-out views, dB, of the models that the CPU and the GPU merge from the same two models.
fn merged(folder: &TempDir) -> Result<Vec<Option<f64>>> {
    let caliterra = dataset("real_caliterra")?;
    let out = |name: &str| folder.path().join(name);
    mission(Some(&caliterra), &[&OPTIONS[..], &["--agents", "2"]].concat(), &out("mission"))?;
    let agents = agents(&out("mission"), 2);
    let of_device = |device: &str| {
        let out = out(&format!("merged-{device}"));
        merge(&agents, &["--epochs", "3", "--device", device], &out)?;
        Ok(Some(psnr(&out, &caliterra)?.held_out))
    };
    DEVICES.into_iter().map(of_device).collect()
}

/// Renders a model at all views on the CPU, and scores it.
fn psnr(model: &Path, data: &Path) -> Result<Psnr> {
    let report = evaluate(model, data, &["--eval-every", "1", "--max-size", "160"])?;
    let views = report["views"].as_array().context("no views")?;
    let psnrs = views.iter().map(|view| view["psnr"].as_f64().context("no PSNR"));
    let psnrs = psnrs.collect::<Result<Vec<f64>>>()?;
    let mean = |is_held_out: bool| {
        let chosen = psnrs.iter().enumerate().filter(|(i, _)| (i % HELD_OUT == 0) == is_held_out);
        let chosen: Vec<f64> = chosen.map(|(_, psnr)| *psnr).collect();
        chosen.iter().sum::<f64>() / chosen.len() as f64
    };
    Ok(Psnr { training: mean(false), held_out: mean(true) })
}

/// The device that trained a model, as its report names it.
fn device_name(out: &Path) -> Result<String> {
    let report: Value = serde_json::from_slice(&std::fs::read(out.join("report.json"))?)?;
    Ok(report["device"].as_str().context("no device")?.to_owned())
}
