//! `cosurf-aggregator`: the command line. It passes the time, the number of cores and the signal of Ctrl-C to the
//! library.

mod cli;

use std::fmt::Display;
use std::io::{self, Write};
use std::num::NonZeroU32;
use std::process::ExitCode;
use std::sync::mpsc;
use std::time::Instant;

use anyhow::{Context, Result};
use clap::{Args, Parser, Subcommand};
use cosurf_aggregator::georeference::write_georeference;
use cosurf_aggregator::mission::MissionError;
use cosurf_aggregator::service::{Command, Host, SideEvent, expected_devices, serve};
use cosurf_aggregator::station::PAGE_BYTES;
use cosurf_cli::{ENDED_BY_SIGNAL, VERSION, shell};
use cosurf_contract::{Escaped, LogFormat, log};
use cosurf_geo::Georeference;
use cosurf_link::SerialConfig;
use cosurf_link::serial::{DEFAULT_BAUD, GATEWAY_MESSAGE_BYTES};
use cosurf_scene::files;
use serde::Serialize;

use cli::arguments::{ConfigArgs, HttpArgs};

/// Ground station of cosurf: receives the splat models that drones send, merges them, and sends the global model back.
#[derive(Parser)]
#[command(version = VERSION, propagate_version = true, arg_required_else_help = true)]
struct Cli {
    #[command(subcommand)]
    command: Commands,
    /// Write a log with times to standard error. LEVEL is error, warn, info (stages), debug (also parts of stages, and
    /// messages) or trace (also steps and passes). FILTER is a list like info,cosurf_link=debug [default: no log]
    #[arg(long, global = true, value_name = "LEVEL|FILTER", help_heading = "Logging")]
    log: Option<String>,
    /// Format of the log: text or json
    #[arg(long, global = true, value_name = "FORMAT", default_value_t, help_heading = "Logging")]
    log_format: LogFormat,
}

#[derive(Subcommand)]
enum Commands {
    #[command(after_help = "Example:\n  cosurf-aggregator eval DIR DATA")]
    Eval(cli::eval::EvalArgs),
    #[command(after_help = "Example:\n  cosurf-aggregator convert MODEL.ply MODEL.spz")]
    Convert(cli::convert::ConvertArgs),
    #[command(after_help = "Example:\n  cosurf-aggregator mesh DIR --out mesh.glb")]
    Mesh(cli::mesh::MeshArgs),
    #[command(after_help = "Example:\n  cosurf-aggregator doctor --config aggregator.toml")]
    Doctor(cli::doctor::DoctorArgs),
    EvalMesh(cli::eval_mesh::EvalMeshArgs),
    #[command(after_help = "Example:\n  cosurf-aggregator forget drone-1 --config aggregator.toml")]
    Forget(cli::forget::ForgetArgs),
    #[command(after_help = "Example:\n  cosurf-aggregator key aggregator.key")]
    Key(cli::key::KeyArgs),
    #[command(after_help = "Example:\n  cosurf-aggregator merge DIR DIR --out MERGED")]
    Merge(cli::merge::MergeArgs),
    #[command(after_help = "Example:\n  cosurf-aggregator mission --data DATA --max-size 640")]
    Mission(cli::mission::MissionArgs),
    #[command(after_help = "Example:\n  cosurf-aggregator password drone-1 < drone-1.password >> users.txt")]
    Password(cli::password::PasswordArgs),
    #[command(
        after_help = "Example:\n  cosurf-aggregator pki keys --host 192.168.1.10 --device drone-1 --device drone-2"
    )]
    Pki(cli::pki::PkiArgs),
    #[command(after_help = "Example:\n  cosurf-aggregator record flight.log --broker mqtt://127.0.0.1:1883")]
    Record(cli::tap::RecordArgs),
    #[command(
        after_help = "Example:\n  cosurf-aggregator replay flight.log --broker mqtt://127.0.0.1:1884 --speed 10"
    )]
    Replay(cli::tap::ReplayArgs),
    #[command(after_help = "Example:\n  cosurf-aggregator restore 7 --config aggregator.toml")]
    Restore(cli::restore::RestoreArgs),
    #[command(after_help = "Example:\n  cosurf-aggregator revoke drone-1 --config aggregator.toml")]
    Revoke(cli::revoke::RevokeArgs),
    #[command(
        after_help = "Example:\n  cosurf-aggregator run --config aggregator.toml --http 127.0.0.1:8080"
    )]
    Run(RunArgs),
    #[command(after_help = "Example:\n  cosurf-aggregator survey DIR --out SURVEY --origin 53.3,16.4,0")]
    Survey(cli::survey::SurveyArgs),
    #[command(after_help = "Example:\n  cosurf-aggregator town PHOTOS --raw --size 800")]
    Town(cli::town::TownArgs),
    #[command(after_help = "Example:\n  cosurf-aggregator view DIR")]
    View(cli::view::ViewArgs),
    #[command(
        after_help = "Example:\n  cosurf-aggregator worker --queue nats://10.0.0.1:4222 --tiles s3://cosurf/tiles"
    )]
    Worker(cli::worker::WorkerArgs),
    #[command(after_help = "Example:\n  \
        cosurf-aggregator completions bash > ~/.local/share/bash-completion/completions/cosurf-aggregator")]
    Completions(shell::CompletionsArgs),
    #[command(after_help = "Example:\n  cosurf-aggregator man ~/.local/share/man/man1")]
    Man(shell::ManArgs),
}

/// Serve a site until stopped: receive models, merge them, send the global model back.
#[derive(Args)]
struct RunArgs {
    #[command(flatten)]
    config: ConfigArgs,
    /// Also serve the device on this serial port, for example a telemetry radio; may be given several times
    #[arg(long, value_name = "PORT")]
    serial: Vec<String>,
    /// Speed of the serial ports in bits per second
    #[arg(long, value_name = "BAUD", default_value_t = DEFAULT_BAUD)]
    baud: NonZeroU32,
    /// Let everybody who reaches `bind` read and send everything, as open = true does
    #[arg(long)]
    open: bool,
    #[command(flatten)]
    http: HttpArgs,
    /// Print every event as a line of JSON
    #[arg(long)]
    json: bool,
}

fn main() -> ExitCode {
    cosurf_engine::budget::return_freed_memory();
    match run_command(Cli::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) if has_closed_pipe(&error) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("cosurf-aggregator: {error:#}");
            let is_stopped = matches!(error.downcast_ref(), Some(MissionError::Interrupted));
            if is_stopped { ExitCode::from(ENDED_BY_SIGNAL) } else { ExitCode::FAILURE }
        }
    }
}

fn run_command(cli: Cli) -> Result<()> {
    if let Some(filter) = &cli.log {
        log::start(filter, cli.log_format)?;
    }
    match cli.command {
        Commands::Convert(args) => cli::convert::run(&args),
        Commands::Doctor(args) => cli::doctor::run(&args),
        Commands::Eval(args) => cli::eval::run(args),
        Commands::Forget(args) => cli::forget::run(&args),
        Commands::Key(args) => cli::key::run(&args),
        Commands::Merge(args) => cli::merge::run(&args),
        Commands::Mission(args) => cli::mission::run(args),
        Commands::Password(args) => cli::password::run(&args),
        Commands::Pki(args) => cli::pki::run(args),
        Commands::Record(args) => cli::tap::record(&args),
        Commands::Replay(args) => cli::tap::replay(&args),
        Commands::Survey(args) => cli::survey::run(&args),
        Commands::Town(args) => cli::town::run(&args),
        Commands::View(args) => cli::view::run(&args),
        Commands::Worker(args) => cli::worker::run(&args),
        Commands::Completions(args) => shell::completions::<Cli>(&args),
        Commands::Man(args) => shell::man::<Cli>(&args),
        Commands::Restore(args) => cli::restore::run(&args),
        Commands::Revoke(args) => cli::revoke::run(&args),
        Commands::Run(args) => run(&args),
        Commands::Mesh(args) => cli::mesh::run(&args),
        Commands::EvalMesh(args) => cli::eval_mesh::run(&args),
    }
}

/// True if a write failed because the reader of the output has closed the pipe, as `head` does. The program then exits
/// without an error.
fn has_closed_pipe(error: &anyhow::Error) -> bool {
    error.downcast_ref().is_some_and(|error: &io::Error| error.kind() == io::ErrorKind::BrokenPipe)
}

fn run(args: &RunArgs) -> Result<()> {
    let mut config = args.config.read()?;
    config.open |= args.open;
    if let Some(origin) = config.origin {
        files::create_folder(&config.out)?;
        write_georeference(Some(&Georeference::at(origin)?), &config.out)?;
    }
    let (commands, receiver) = mpsc::channel();
    ctrlc::set_handler(move || {
        let _ = commands.send(Command::Stop); // fails only if the service has already ended
    })
    .context("cannot install the Ctrl-C handler")?;
    let (begun, json) = (Instant::now(), args.json);
    let site = args.http.serve(&config.out, true)?;
    let board = site.as_ref().map(|site| site.board.clone());
    board.iter().for_each(|board| board.expect(expected_devices(&config)));
    let heard = board.clone();
    let line =
        |port: &String| SerialConfig::device(port, args.baud, cli::host::session(), GATEWAY_MESSAGE_BYTES);
    let served = serve(
        &config,
        Host {
            clock_s: cli::host::session(),
            threads: cli::host::cores(),
            reporter: cosurf_aggregator::outputs::report,
            page_bytes: site.as_ref().map(|_| PAGE_BYTES),
        },
        args.serial.iter().map(line).collect(),
        move || begun.elapsed(),
        &receiver,
        |event| {
            board.iter().for_each(|board| board.note_service(event));
            show(event, json);
        },
        move |event| match (&event, &heard) {
            (SideEvent::Status(said), Some(board)) => board.note_heard(said),
            _ => show(&event, json),
        },
    );
    match served {
        Err(error) if error.is_setting() => {
            Err(error).with_context(|| args.config.path().display().to_string())
        }
        served => Ok(served?),
    }
}

/// Prints an event on a line of its own, in which nothing from outside can begin another line. Write errors are ignored, so that the service goes on if nobody reads its
/// output.
fn show(event: &(impl Display + Serialize), json: bool) {
    let mut stdout = io::stdout().lock();
    let _ = match json {
        true => writeln!(stdout, "{}", serde_json::json!(event)),
        false => writeln!(stdout, "{}", Escaped(event)),
    };
}
