//! `cosurf-aggregator`: the command line, and all that the library must not know by itself: clock,
//! environment, signals.

use std::io::{self, Write};
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::mpsc;
use std::time::{Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result};
use clap::{Args, Parser, Subcommand};
use cosurf_aggregator::field::{self, AggregatorConfig};
use cosurf_aggregator::service::Command;

/// The ground side of cosurf: takes in the splat models that drones send, joins them, sends them back.
#[derive(Parser)]
#[command(version, propagate_version = true, arg_required_else_help = true)]
struct Cli {
    #[command(subcommand)]
    command: Commands,
}

#[derive(Subcommand)]
enum Commands {
    Run(RunArgs),
}

/// Serve a site until stopped: receive models, join them, send the global model back.
#[derive(Args)]
struct RunArgs {
    /// The configuration: site, out, and either bind or broker
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// Print every event as a line of JSON
    #[arg(long)]
    json: bool,
}

fn main() -> ExitCode {
    let outcome = match Cli::parse().command {
        Commands::Run(args) => run(&args),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn run(args: &RunArgs) -> Result<()> {
    let path = args.config.display();
    let text = std::fs::read_to_string(&args.config).with_context(|| path.to_string())?;
    let config: AggregatorConfig = toml::from_str(&text)
        .map_err(|error| anyhow::anyhow!("{path}: {}", error.to_string().trim().replace('\n', " ")))?;
    let (commands, orders) = mpsc::channel();
    ctrlc::set_handler(move || {
        let _ = commands.send(Command::Finish); // fails only where the service has ended already
    })
    .context("Ctrl-C cannot be caught")?;
    let begun = Instant::now();
    field::serve(
        &config,
        session(),
        || begun.elapsed(),
        &orders,
        |event| {
            let mut stdout = io::stdout().lock();
            let shown = match args.json {
                true => writeln!(stdout, "{}", serde_json::json!(event)),
                false => writeln!(stdout, "{event}"),
            };
            let _ = shown; // it serves on although nobody looks
        },
    )?;
    Ok(())
}

/// Seconds since 1970; a clock before that is a clock that was never set.
fn session() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs())
}
