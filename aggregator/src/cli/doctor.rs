//! `doctor`: checks the computer of a ground station, and what the station connects to.

use anyhow::Result;
use clap::Args;
use cosurf_aggregator::queue::Queue;
use cosurf_aggregator::service::{AggregatorConfig, MemoryBound, neighbours};
use cosurf_aggregator::store::Store;
use cosurf_cli::doctor::{Doctor, Finding, clock, colmap, compute, disk, line, memory, port};
use cosurf_engine::DeviceChoice;
use cosurf_scene::{FolderLock, SceneError};

use super::arguments::ConfigArgs;
use super::host::session;

/// Room on the disk for models and revisions of a first mission, bytes.
const ROOM_BYTES: u64 = 1 << 30;

/// Check this computer, and what a ground station connects to, and tell what to mend: clock, memory, graphics card, disk,
/// port, brokers, the workers' queue and tiles, COLMAP. Fails if anything must be mended.
#[derive(Args)]
pub(crate) struct DoctorArgs {
    #[command(flatten)]
    config: ConfigArgs,
    /// Print JSON instead of text, one line for each check
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(args: &DoctorArgs) -> Result<()> {
    let mut doctor = Doctor::new(args.json);
    let path = args.config.path().display();
    match args.config.path().exists().then(|| args.config.read()) {
        Some(Ok(config)) => {
            doctor.tell(&Finding::ok("config", format!("{path} can be read")))?;
            check_station(&config, &mut doctor)?;
        }
        Some(Err(error)) => doctor.tell(&Finding::failed("config", format_args!("{error:#}")))?,
        None => {
            let remedy = "write it, or name another with --config";
            doctor.tell(&Finding::note("config", format!("{path}: there is no such file"), remedy))?;
            doctor.tell(&compute::check(DeviceChoice::Auto))?;
        }
    }
    doctor.tell(&clock::check())?;
    doctor.tell(&colmap::check())?;
    doctor.finish()
}

/// Checks what the configuration of a ground station needs.
fn check_station(config: &AggregatorConfig, doctor: &mut Doctor) -> Result<()> {
    doctor.tell(&compute::check(config.compute))?;
    let settings = "`memory`, `broker_memory` or `merge_memory`";
    doctor.tell(&memory::check(MemoryBound::of(config).at_most_bytes(), settings))?;
    doctor.tell(&disk::check(&config.out, ROOM_BYTES))?;
    match is_in_use(config)? {
        // The broker would end the connection of the program that runs.
        Some(holder) => {
            doctor.tell(&Finding::ok("service", format!("connections not checked: {holder} runs")))
        }
        None => check_connections(config, doctor),
    }
}

/// The program that uses the station's folder, if there is one.
fn is_in_use(config: &AggregatorConfig) -> Result<Option<String>> {
    if !config.out.is_dir() {
        return Ok(None);
    }
    match FolderLock::take(&config.out, "cosurf-aggregator doctor") {
        Ok(_) => Ok(None),
        Err(SceneError::InUse { holder, .. }) => Ok(Some(holder)),
        Err(error) => Err(error.into()),
    }
}

fn check_connections(config: &AggregatorConfig, doctor: &mut Doctor) -> Result<()> {
    if let Some(bind) = config.bind {
        doctor.tell(&port::check(bind, "`bind`"))?;
    }
    match neighbours(config, session()) {
        Ok(neighbours) => {
            for (setting, neighbour) in neighbours {
                doctor.tell(&line::broker(setting, neighbour))?;
            }
        }
        Err(error) => doctor.tell(&Finding::failed("settings", error))?,
    }
    let Some(workers) = &config.workers else { return Ok(()) };
    let queue = Queue::open(&workers.queue).map(drop);
    doctor.tell(
        &queue.map_or_else(|error| Finding::failed("queue", error), |()| Finding::ok("queue", "connected")),
    )?;
    let tiles = Store::open(&workers.tiles).map(drop);
    doctor.tell(
        &tiles.map_or_else(|error| Finding::failed("tiles", error), |()| Finding::ok("tiles", "answers")),
    )
}
