//! The command line, with one module for each command: its options, and the calls into the library.

mod arguments;
#[cfg(feature = "gpu")]
mod devices;
mod eval;
mod host;
mod key;
mod paths;
mod progress;
mod render;
mod run;
mod train;

use anyhow::Result;
use clap::{Parser, Subcommand};

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
