//! `render`: renders a model from the cameras of a dataset.

use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use cosurf_agent::pictures;
use cosurf_scene::{Dataset, LocalFrame, files};

use super::arguments::{Common, ViewingArgs};

/// Render a model from the cameras of a dataset: colour, depth and normal as PNG, depth also as 32-bit floats (PFM,
/// metres along the optical axis, 0 where there is no surface).
#[derive(Args, Debug)]
pub(super) struct RenderArgs {
    /// The model: a PLY or SPZ file, or the folder of a training, a merge or a mission
    model: PathBuf,
    /// The dataset with the cameras, or the folder of a model; needs no photographs
    #[arg(long, value_name = "DATA")]
    cameras: PathBuf,
    /// The folder to write to
    #[arg(long, value_name = "DIR", default_value = "out/pictures")]
    out: PathBuf,
    #[command(flatten)]
    viewing: ViewingArgs,
    #[command(flatten)]
    common: Common,
}

pub(super) fn run(args: &RenderArgs) -> Result<()> {
    // First, so that a wrong folder is told before the work.
    files::create_folder(&args.out)?;
    let dataset = Dataset::posed(&args.cameras)?;
    let frame = LocalFrame::of(dataset.cameras_of_views());
    let dataset = dataset.into_frame(&frame);
    let max_size_px = args.common.max_size_px();
    let cameras: Vec<_> = dataset.views.iter().map(|view| view.camera.fitted(max_size_px)).collect();
    let beside_bytes = pictures::scratch_bytes(&cameras);
    let mut model = args.viewing.open(&args.model, &frame, &cameras, args.common.threads(), beside_bytes)?;
    for (done, view) in dataset.views.iter().enumerate() {
        pictures::write(&mut model, view, max_size_px, frame.unit(), &args.out)?;
        if args.common.json {
            let line = serde_json::json!({ "view": view.name, "done": done + 1, "of": dataset.views.len() });
            let _ = writeln!(io::stdout(), "{line}"); // a closed pipe does not stop the rendering
        } else {
            eprintln!("{}/{} {}", done + 1, dataset.views.len(), view.name);
        }
    }
    Ok(())
}
