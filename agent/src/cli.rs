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

use std::process::ExitCode;

use anyhow::Result;
use clap::{Parser, Subcommand};
use cosurf_cli::{ENDED_BY_SIGNAL, VERSION, shell};
use cosurf_contract::{ENDS_WITH_STDIN, LogFormat, log};

/// Train a Gaussian-splat surface model from drone pictures, within a memory limit, on this computer's CPU or GPU. `ingest`
/// finds the pictures' poses first.
#[derive(Debug, Parser)]
#[command(version = VERSION, propagate_version = true)]
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
    #[command(after_help = "Example:\n  cosurf-agent ingest PHOTOS --out DATA --origin 30.1712,-98.0897,300")]
    Ingest(ingest::IngestArgs),
    #[command(after_help = "Example:\n  cosurf-agent train DATA --out DIR --max-size 640 --memory 1GiB")]
    Train(train::TrainArgs),
    #[command(after_help = "Example:\n  cosurf-agent eval DIR DATA --max-size 640")]
    Eval(eval::EvalArgs),
    #[command(after_help = "Example:\n  cosurf-agent render DIR --cameras DATA --out PICTURES")]
    Render(render::RenderArgs),
    #[command(after_help = "Example:\n  cosurf-agent run --config agent.toml")]
    Run(run::RunArgs),
    #[command(after_help = "Example:\n  cosurf-agent preflight --config agent.toml")]
    Preflight(run::PreflightArgs),
    #[command(after_help = "Example:\n  cosurf-agent doctor --config agent.toml")]
    Doctor(run::DoctorArgs),
    #[command(after_help = "Example:\n  cosurf-agent key drone-1.key --device drone-1")]
    Key(key::KeyArgs),
    #[cfg(feature = "gpu")]
    Devices(devices::DevicesArgs),
    #[command(after_help = "Example:\n  \
        cosurf-agent completions bash > ~/.local/share/bash-completion/completions/cosurf-agent")]
    Completions(shell::CompletionsArgs),
    #[command(after_help = "Example:\n  cosurf-agent man ~/.local/share/man/man1")]
    Man(shell::ManArgs),
}

/// The exit code of the program after an error.
pub(crate) fn failure() -> ExitCode {
    if stop::is_asked() { ExitCode::from(ENDED_BY_SIGNAL) } else { ExitCode::FAILURE }
}

pub(crate) fn run(cli: Cli) -> Result<()> {
    if let Some(filter) = &cli.log {
        log::start(filter, cli.log_format)?;
    }
    if matches!(cli.command, Command::Train(_) | Command::Run(_)) {
        stop::listen()?;
        if std::env::var_os(ENDS_WITH_STDIN).is_some() {
            stop::end_with_stdin();
        }
    }
    match cli.command {
        Command::Ingest(args) => ingest::run(&args),
        Command::Train(args) => train::run(&args),
        Command::Eval(args) => eval::run(&args),
        Command::Render(args) => render::run(&args),
        Command::Run(args) => run::run(&args),
        Command::Preflight(args) => run::preflight(&args),
        Command::Doctor(args) => run::doctor(&args),
        Command::Key(args) => key::run(&args),
        #[cfg(feature = "gpu")]
        Command::Devices(args) => devices::run(&args),
        Command::Completions(args) => shell::completions::<Cli>(&args),
        Command::Man(args) => shell::man::<Cli>(&args),
    }
}
