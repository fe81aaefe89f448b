//! The agent's command line. Each command has a module with its options and its calls into the library.

mod arguments;
mod curve;
#[cfg(feature = "gpu")]
mod devices;
mod eval;
mod host;
mod ingest;
mod key;
mod paths;
mod progress;
mod render;
mod run;
mod stop;
mod train;

use anyhow::Result;
use clap::{Parser, Subcommand};
use cosurf_contract::{LogFormat, log};

/// Train a Gaussian-splat surface model from drone pictures, within a memory limit, on this computer's CPU or GPU. `ingest`
/// finds the pictures' poses first.
#[derive(Debug, Parser)]
#[command(version, propagate_version = true)]
pub(crate) struct Cli {
    #[command(subcommand)]
    command: Command,
    /// Write a log with times to standard error. LEVEL is error, warn, info (stages), debug (also parts of stages, and
    /// messages) or trace (also steps and passes). FILTER is a list like info,cosurf_engine=trace [default: no log]
    #[arg(long, global = true, value_name = "LEVEL|FILTER", help_heading = "Logging")]
    log: Option<String>,
    /// Format of the log: text or json
    #[arg(long, global = true, value_name = "FORMAT", default_value_t, help_heading = "Logging")]
    log_format: LogFormat,
}

#[derive(Debug, Subcommand)]
enum Command {
    Ingest(ingest::IngestArgs),
    Train(train::TrainArgs),
    Eval(eval::EvalArgs),
    Render(render::RenderArgs),
    Run(run::RunArgs),
    Preflight(run::PreflightArgs),
    Key(key::KeyArgs),
    #[cfg(feature = "gpu")]
    Devices(devices::DevicesArgs),
}

pub(crate) fn run(cli: Cli) -> Result<()> {
    if let Some(filter) = &cli.log {
        log::start(filter, cli.log_format)?;
    }
    if matches!(cli.command, Command::Train(_) | Command::Run(_)) {
        stop::listen()?;
    }
    match cli.command {
        Command::Ingest(args) => ingest::run(&args),
        Command::Train(args) => train::run(&args),
        Command::Eval(args) => eval::run(&args),
        Command::Render(args) => render::run(&args),
        Command::Run(args) => run::run(&args),
        Command::Preflight(args) => run::preflight(&args),
        Command::Key(args) => key::run(&args),
        #[cfg(feature = "gpu")]
        Command::Devices(args) => devices::run(&args),
    }
}
