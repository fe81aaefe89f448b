//! `eval`: scores a model.

use std::io::{self, Write};
use std::path::PathBuf;
use std::thread::available_parallelism;

use anyhow::Result;
use clap::Args;
use cosurf_aggregator::evaluate::{EvalOrder, evaluate_model, table};
use cosurf_scene::{model, ply};

/// Score a model on the held-out views of a dataset.
///
/// Prints PSNR and SSIM as 3DGS defines them, and LPIPS if --lpips is given. If there is a true surface (gt/mesh.ply in
/// the dataset, or --truth), also prints the errors of depth and normals. The true normal of a pixel is the mean over
/// the pixel's area.
#[derive(Args)]
pub(crate) struct EvalArgs {
    /// The model: a PLY or SPZ file, or the output folder of an agent or a mission
    model: PathBuf,
    /// The dataset's folder
    data: PathBuf,
    /// Folder with the LPIPS weights, vgg.safetensors and alex.safetensors
    #[arg(long, value_name = "FOLDER")]
    lpips: Option<PathBuf>,
    /// The true surface as a mesh [default: DATA/gt/mesh.ply if it exists]
    #[arg(long, value_name = "MESH.ply")]
    truth: Option<PathBuf>,
    /// Score every N-th view by sorted name; use the same N as in training, so that only held-out views are scored
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = clap::value_parser!(u32).range(1..))]
    eval_every: u32,
    /// Shrink pictures until their long side is at most this many pixels [default: full size]
    #[arg(long, value_name = "PX", value_parser = clap::value_parser!(u32).range(16..))]
    max_size: Option<u32>,
    /// Align each view with the model first, for a model whose poses were learnt
    #[arg(long)]
    align: bool,
    /// Print the figures as a line of JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(args: EvalArgs) -> Result<()> {
    let model = ply::of_model(&args.model)?;
    if let Some(note) = model::unusable_note(&model) {
        eprintln!("{note}");
    }
    let report = evaluate_model(&EvalOrder {
        model,
        data: args.data,
        lpips: args.lpips,
        truth: args.truth,
        eval_every: args.eval_every,
        max_size_px: args.max_size,
        align: args.align,
        threads: available_parallelism().map_or(1, usize::from),
    })?;
    let text = if args.json { serde_json::to_string(&report)? + "\n" } else { table(&report) };
    io::stdout().lock().write_all(text.as_bytes())?;
    Ok(())
}
