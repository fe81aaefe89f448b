//! `eval`: scores a model on held-out pictures.

use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::{Result, ensure};
use clap::Args;
use cosurf_agent::{evaluate, viewing};
use cosurf_scene::{Camera, Dataset, LocalFrame, Opened, Shrinking, View};

use super::arguments::{Common, ViewingArgs};

/// Score a model on the held-out views of a dataset: PSNR and SSIM as defined by 3DGS.
#[derive(Args, Debug)]
pub(super) struct EvalArgs {
    /// The model: a PLY or SPZ file, or the folder of a training, a merge or a mission
    model: PathBuf,
    /// The dataset's folder
    data: PathBuf,
    /// Score every n-th view by sorted name; use the same N as in training, so that only held-out views are scored
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = clap::value_parser!(u32).range(1..))]
    eval_every: u32,
    /// Align each view with the model first, for a model whose poses were learnt
    #[arg(long)]
    align: bool,
    #[command(flatten)]
    viewing: ViewingArgs,
    #[command(flatten)]
    common: Common,
}

pub(super) fn run(args: &EvalArgs) -> Result<()> {
    let Opened { mut dataset, damaged, .. } = Dataset::open_within(&args.data, 0)?;
    damaged.iter().for_each(|line| eprintln!("left out: {line}"));
    if let Some(folder) = dataset.take_smaller_pictures(args.common.max_size_px()) {
        eprintln!("{}: its smaller pictures suffice and are used", folder.display());
    }
    let frame = LocalFrame::of(dataset.cameras_of_views());
    let dataset = dataset.into_frame(&frame);
    let (_, held_out) = dataset.split(args.eval_every);
    ensure!(!held_out.is_empty(), "{}: no view is held out", args.data.display());
    let views: Vec<View> = held_out.into_iter().map(|i| dataset.views[i].clone()).collect();
    let max_size_px = args.common.max_size_px();
    let cameras: Vec<_> = views.iter().map(|view| view.camera.fitted(max_size_px)).collect();
    let beside_bytes = evaluate::scratch_bytes(&views, max_size_px, Shrinking::AfterDecoding)?;
    let mut model = args.viewing.open(&args.model, &frame, &cameras, args.common.threads(), beside_bytes)?;
    let extent = args.align.then(|| dataset.extent());
    let render = |camera: &Camera| viewing::render(&mut model, camera);
    let score = evaluate::score(render, &views, max_size_px, Shrinking::AfterDecoding, extent)?;
    let mut stdout = io::stdout().lock();
    if args.common.json {
        writeln!(stdout, "{}", serde_json::to_string(&score)?)?;
        return Ok(());
    }
    for view in &score.views {
        writeln!(stdout, "{}: PSNR {:.2} dB, SSIM {:.4}", view.name, view.psnr, view.ssim)?;
    }
    if let (Some(psnr), Some(ssim)) = (score.psnr, score.ssim) {
        writeln!(stdout, "mean of {}: PSNR {psnr:.2} dB, SSIM {ssim:.4}", score.views.len())?;
    }
    Ok(())
}
