//! The command line: what the options mean, and one module for each command.

#[cfg(feature = "gpu")]
mod devices;
mod eval;
mod key;
mod progress;
mod render;
mod run;
mod train;

use std::path::{Path, PathBuf};

use anyhow::Result;
use clap::{Args, Parser, Subcommand};
use cosurf_agent::publish::global_ply;
use cosurf_engine::DeviceChoice;
use cosurf_scene::bytes::parse_bytes;

/// Train a Gaussian-surface model from drone pictures with known poses, within a memory limit, on this computer's
/// CPU or GPU.
#[derive(Debug, Parser)]
#[command(version, propagate_version = true)]
pub(crate) struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Train(train::TrainArgs),
    Eval(eval::EvalArgs),
    Render(render::RenderArgs),
    Run(run::RunArgs),
    Key(key::KeyArgs),
    #[cfg(feature = "gpu")]
    Devices(devices::DevicesArgs),
}

/// Options that several commands share.
#[derive(Args, Clone, Debug)]
struct Common {
    /// Shrink pictures until their long side is at most this many pixels [default: full size]
    #[arg(long, value_name = "PX", value_parser = clap::value_parser!(u32).range(16..))]
    max_size: Option<u32>,
    /// Number of CPU threads [default: one per core]
    #[arg(long, value_name = "N", value_parser = parse_threads)]
    threads: Option<usize>,
    /// Print JSON instead of text
    #[arg(long)]
    json: bool,
}

/// The option of commands that train or render.
#[derive(Args, Clone, Debug)]
struct DeviceArgs {
    /// Device to compute on: auto (a hardware GPU if there is one, otherwise the CPU), cpu, gpu, or gpu:N with a
    /// number that `devices` lists
    #[arg(long, value_name = "DEVICE", default_value_t)]
    device: DeviceChoice,
}

impl Common {
    fn max_size_px(&self) -> u32 {
        self.max_size.unwrap_or(u32::MAX)
    }

    fn threads(&self) -> usize {
        self.threads.unwrap_or_else(cores)
    }
}

/// Number of CPU cores of this computer.
fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

fn parse_threads(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(threads @ 1..=1024) => Ok(threads),
        _ => Err("give a number from 1 to 1024".into()),
    }
}

fn parse_memory(text: &str) -> Result<u64, String> {
    parse_bytes(text)
}

/// The memory limit if none is given, bytes: two thirds of the free memory, at most 8 GiB.
fn default_memory() -> u64 {
    cosurf_agent::usage::available_bytes().map_or(2 << 30, |free| free / 3 * 2).min(8 << 30)
}

/// The PLY of a finished model, given that file or the folder that training wrote.
fn model_path(path: &Path) -> PathBuf {
    if path.is_dir() { path.join("model.ply") } else { path.to_path_buf() }
}

/// The model that training starts from. The word `global` stands for the global model that `out` received earlier.
fn resolve_init(init: Option<&PathBuf>, out: &Path) -> Option<PathBuf> {
    init.map(|init| if init.as_os_str() == "global" { global_ply(out) } else { init.clone() })
}

pub(crate) fn run(cli: Cli) -> Result<()> {
    match cli.command {
        Command::Train(args) => train::run(&args),
        Command::Eval(args) => eval::run(&args),
        Command::Render(args) => render::run(&args),
        Command::Run(args) => run::run(&args),
        Command::Key(args) => key::run(&args),
        #[cfg(feature = "gpu")]
        Command::Devices(args) => devices::run(&args),
    }
}
