//! `render`: renders a model from the cameras of a dataset.

use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::Args;
use cosurf_agent::{pictures, viewing};
use cosurf_scene::Dataset;
use cosurf_scene::bytes::parse_bytes;

use super::arguments::{Common, DeviceArgs};
use super::paths::model_path;

/// Render a model from the cameras of a dataset: colour, depth and normal as PNG, depth also as 32-bit floats (PFM,
/// metres along the optical axis, 0 where there is no surface).
#[derive(Args, Debug)]
pub(super) struct RenderArgs {
    /// The model: a PLY, or a folder that training wrote
    model: PathBuf,
    /// The dataset with the cameras
    #[arg(long, value_name = "DATA")]
    cameras: PathBuf,
    /// The folder to write to
    #[arg(long, value_name = "DIR", default_value = "out/pictures")]
    out: PathBuf,
    /// Limit on resident memory, for example 300MiB; the pictures are then rendered on the CPU [default: no limit]
    #[arg(long, value_name = "BYTES", value_parser = parse_bytes)]
    memory: Option<u64>,
    #[command(flatten)]
    device: DeviceArgs,
    #[command(flatten)]
    common: Common,
}

pub(super) fn run(args: &RenderArgs) -> Result<()> {
    let (dataset, _) = Dataset::open_within(&args.cameras, 0)?;
    let max_size_px = args.common.max_size_px();
    let cameras: Vec<_> = dataset.views.iter().map(|view| view.camera.fitted(max_size_px)).collect();
    let beside_bytes = pictures::scratch_bytes(&cameras);
    let mut renderer = viewing::open(
        &model_path(&args.model),
        &cameras,
        args.device.device,
        args.common.threads(),
        args.memory,
        beside_bytes,
    )?;
    std::fs::create_dir_all(&args.out).with_context(|| args.out.display().to_string())?;
    for (done, view) in dataset.views.iter().enumerate() {
        pictures::write(&mut renderer, view, max_size_px, &args.out)?;
        if args.common.json {
            let line = serde_json::json!({ "view": view.name, "done": done + 1, "of": dataset.views.len() });
            let _ = writeln!(io::stdout(), "{line}"); // a closed pipe does not stop the rendering
        } else {
            eprintln!("{}/{} {}", done + 1, dataset.views.len(), view.name);
        }
    }
    Ok(())
}
