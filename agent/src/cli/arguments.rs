//! Options that several commands take.

use std::path::Path;

use anyhow::Result;
use clap::Args;
use cosurf_agent::viewing;
use cosurf_engine::{DeviceChoice, Views};
use cosurf_scene::bytes::parse_bytes;
use cosurf_scene::{Camera, LocalFrame, model as model_file, ply};

use super::host::cores;

/// Options of the commands that train, score or render a model.
#[derive(Args, Clone, Debug)]
pub(super) struct Common {
    /// Shrink pictures until their long side is at most this many pixels [default: full size]
    #[arg(long, value_name = "PX", value_parser = clap::value_parser!(u32).range(16..))]
    max_size: Option<u32>,
    /// Number of CPU threads [default: one per core]
    #[arg(long, value_name = "N", value_parser = parse_threads)]
    threads: Option<usize>,
    /// Print JSON instead of text
    #[arg(long)]
    pub(super) json: bool,
}

impl Common {
    /// Limit on the long side of the pictures, pixels; `u32::MAX` for full size.
    pub(super) fn max_size_px(&self) -> u32 {
        self.max_size.unwrap_or(u32::MAX)
    }

    /// Number of CPU threads.
    pub(super) fn threads(&self) -> usize {
        self.threads.unwrap_or_else(cores)
    }
}

/// The device option of the commands that train, score or render a model.
#[derive(Args, Clone, Debug)]
pub(super) struct DeviceArgs {
    /// Device to compute on: auto (a hardware GPU if there is one, otherwise the CPU), cpu, gpu, or gpu:N with a
    /// number that `devices` lists. With --memory, auto is the CPU for `eval` and `render`, which cannot use a GPU then, and
    /// for `train` if the limit is too small for the GPU
    #[arg(long = "compute", alias = "device", value_name = "DEVICE", default_value_t)]
    pub(super) device: DeviceChoice,
}

/// Options of the commands that render a finished model.
#[derive(Args, Clone, Debug)]
pub(super) struct ViewingArgs {
    /// Limit on resident memory, for example 300MiB; the pictures are then rendered on the CPU, and a model that is too
    /// large is read once for every few pictures [default: no limit]
    #[arg(long, value_name = "BYTES", value_parser = parse_bytes)]
    memory: Option<u64>,
    #[command(flatten)]
    device: DeviceArgs,
}

impl ViewingArgs {
    /// Opens the model of a file or folder to render it from `cameras`, which are in `frame`. The command needs
    /// `beside_bytes` for other things.
    pub(super) fn open(
        &self,
        model: &Path,
        frame: &LocalFrame,
        cameras: &[Camera],
        threads: usize,
        beside_bytes: u64,
    ) -> Result<Views> {
        let (device, model) = (self.device.device, ply::of_model(model)?);
        if let Some(note) = model_file::unusable_note(&model) {
            eprintln!("{note}");
        }
        viewing::open(model, frame, cameras, device, threads, self.memory, beside_bytes)
    }
}

fn parse_threads(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(threads @ 1..=1024) => Ok(threads),
        _ => Err("give a number from 1 to 1024".into()),
    }
}
