//! `mission`: runs a whole mission on this machine, from pictures to a report.

use std::io::{self, Write};
use std::path::{Path, PathBuf, absolute};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use anyhow::{Context, Result, bail, ensure};
use clap::Args;
use cosurf_aggregator::mission::{Flown, MissionError, MissionOrder, SURVEY, Settings, Surroundings, fly};
use cosurf_aggregator::partition::{DEFAULT_MARGIN, Division, read_cells};
use cosurf_aggregator::report::{MissionReport, table};
use cosurf_aggregator::station::PAGE_BYTES;
use cosurf_city::CitySettings;
use cosurf_contract::usage;
use cosurf_engine::PoseChoice;
use cosurf_link::BrokerAddress;
use cosurf_scene::bytes::{format_bytes, parse_bytes};
use cosurf_scene::{Dataset, FolderLock};

use super::arguments::HttpArgs;
use super::host::{cores, display, session};
use super::merge::Ways;

/// Least memory for the merge of a mission with a page, bytes. The merge itself tells if a model needs more.
const MERGE_BYTES_MIN: u64 = 64 << 20;
/// Long side to which photographs are shrunk, pixels, unless `--max-size` tells another one. With it, 75 photographs take
/// less than 20 minutes on two cores from photographs to survey; with 640 pixels 21, and at their 1,280 pixels the training
/// alone takes 35.
const PHOTOGRAPHS_PX: u32 = 512;

/// Run a whole mission on this machine, from drone pictures to a global model and a report.
///
/// Divides the pictures among agents by area, starts a broker and one process per agent, and merges the models that
/// the agents train. Writes global.ply, mesh.ply, report.json and report.html to the output folder. If the data tell where on
/// the earth they lie (geo.json), maps and points are in OUT/survey. The same command in the same folder resumes a mission
/// that was stopped.
#[derive(Args)]
pub(crate) struct MissionArgs {
    /// Pictures with poses, as `cosurf-agent train` reads them; or a drone's photographs, of which `cosurf-agent ingest` then
    /// makes a dataset in OUT/data [default: a synthetic city is rendered]
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    /// Output folder
    #[arg(long, value_name = "DIR", default_value = "out")]
    out: PathBuf,
    /// Number of edge aggregators below the root aggregator, each with its own agents; 0 for none
    #[arg(long, value_name = "E", default_value_t = 0, value_parser = clap::value_parser!(u16).range(0..=99))]
    edges: u16,
    /// Number of agents that share the pictures; with --edges, number of agents of each edge aggregator
    #[arg(long, value_name = "N", default_value_t = 4, value_parser = clap::value_parser!(u16).range(1..=999))]
    agents: u16,
    /// Instead of --agents, one agent for each cell of a grid; with --edges, one grid for each edge aggregator
    #[arg(long, value_name = "COLUMNSxROWS", value_parser = parse_grid, conflicts_with_all = ["agents", "cells"])]
    grid: Option<Division>,
    /// Instead of --agents, one agent for each polygon of this GeoJSON file. Corners are given in the horizontal world
    /// coordinates of the data (x and y if z is up). With --edges, each edge aggregator takes the same number of
    /// polygons, in file order
    #[arg(long, value_name = "FILE", conflicts_with = "agents")]
    cells: Option<PathBuf>,
    /// Width of the margin around each cell, as a share of the cell's size, 0 to 1. The cell's agent also trains on
    /// views of other cells that look at the margin; 0 for no margin
    #[arg(long, value_name = "SHARE", default_value_t = DEFAULT_MARGIN, value_parser = parse_margin)]
    margin: f64,
    /// Training steps of each agent, in all rounds together
    #[arg(long, value_name = "N", default_value_t = 1500, value_parser = clap::value_parser!(u32).range(1..))]
    steps: u32,
    /// Number of rounds that share the steps: in each, all agents train and their models are merged; in all but the first,
    /// they begin from the global model of the round before. Two long rounds end with a better model than one
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=9))]
    rounds: u32,
    /// Memory limit of each agent, for example 500MiB
    #[arg(long, value_name = "BYTES", default_value = "1GiB", value_parser = parse_bytes)]
    memory: u64,
    /// Shrink pictures until their long side is at most this many pixels [default: full size; 512 if poses must be found]
    #[arg(long, value_name = "PX", value_parser = clap::value_parser!(u32).range(16..))]
    max_size: Option<u32>,
    /// Poses of the pictures: `fixed` takes them as exact, `learn` corrects them while the agents train, `auto` does so if they
    /// turn out not to be exact
    #[arg(long, value_name = "WAY", default_value_t)]
    poses: PoseChoice,
    /// Seed of every random choice; the same seed gives the same bytes
    #[arg(long, value_name = "S", default_value_t = 0, value_parser = clap::value_parser!(u64).range(..1 << 62))]
    seed: u64,
    /// Use this MQTT broker, for example mqtt://127.0.0.1:1883 [default: a built-in broker is started]
    #[arg(long, value_name = "URL")]
    broker: Option<BrokerAddress>,
    /// Hold out every N-th picture by name from training, to score the models; 0 holds out none
    #[arg(long, value_name = "N", default_value_t = 8)]
    eval_every: u32,
    /// Where another agent observed the ground better, let an agent send only a base, a small stand-in for its splats there. On
    /// Caliterra, uploads are 40 % smaller then, and the global model loses 0.25 dB of PSNR
    #[arg(long)]
    compress_first: bool,
    #[command(flatten)]
    ways: Ways,
    /// Limit on the memory of this process while it merges, scores and draws, for example 500MiB; with --http also for the
    /// page
    #[arg(long, value_name = "BYTES", default_value = "4GiB", value_parser = parse_bytes)]
    merge_memory: u64,
    /// Also score the global model by LPIPS, with the weights vgg.safetensors and alex.safetensors in this folder
    #[arg(long, value_name = "FOLDER")]
    lpips: Option<PathBuf>,
    /// Grid of a geoid, a GeoTIFF of PROJ or a .gtx file: heights of the survey are then above it, and those in gcp_list.txt
    /// and geo.txt are taken to be
    #[arg(long, value_name = "FILE")]
    geoid: Option<PathBuf>,
    #[command(flatten)]
    http: HttpArgs,
    /// Print every event, and at the end the report, as lines of JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(args: MissionArgs) -> Result<()> {
    let out = absolute(&args.out).context("--out")?;
    let _lock = FolderLock::take(&out, "cosurf-aggregator mission")?;
    let geoid = args.geoid.as_ref().map(absolute).transpose().context("--geoid")?;
    let data = args.data.as_ref().map(absolute).transpose().context("--data")?;
    let merge_memory = merge_memory(args.merge_memory, args.http.is_served())?;
    let site = args.http.serve(&out, false)?;
    let around =
        Surroundings { board: site.as_ref().map(|site| site.board.clone()), ..surroundings(args.json)? };
    let mut max_size_px = args.max_size;
    let (data, ingest_s) = match data {
        Some(photographs) if Dataset::is_without_poses(&photographs) => {
            let begun = (around.now)();
            let data = ingest(&around.agent, &photographs, &out.join("data"), geoid.as_deref(), args.json)?;
            max_size_px = Some(training_px(&data, args.max_size)?);
            (Some(data), Some(((around.now)() - begun).as_secs_f64()))
        }
        data => (data, None),
    };
    if args.broker.as_ref().is_some_and(|broker| broker.is_tls) {
        bail!("--broker: a mission does not use TLS; give an mqtt:// or ws:// address");
    }
    let order = MissionOrder {
        settings: Settings {
            data: data.clone().unwrap_or_else(|| out.join("city")),
            edges: usize::from(args.edges),
            division: division(&args)?,
            margin: args.margin,
            steps: args.steps,
            rounds: args.rounds,
            memory_bytes: Some(args.memory),
            max_size_px,
            poses: args.poses,
            seed: args.seed,
            eval_every: args.eval_every,
            compress_first: args.compress_first,
            merge: args.ways.settings(true, merge_memory, args.seed),
        },
        ingest_s,
        city: data.is_none().then(|| city_of_seed(args.seed)),
        out,
        broker: args.broker,
        geoid,
        lpips: args.lpips,
    };
    let Flown { report, accuracy } = fly(&order, &around)?;
    print_report(&report, &order.out, args.json)?;
    if let Some(accuracy) = accuracy {
        let survey_s = report.whole.phases.last().map_or(0.0, |phase| phase.seconds);
        super::survey::print(&accuracy, &order.out.join(SURVEY), survey_s, args.json)?;
    }
    let failed =
        report.agents.iter().filter_map(|agent| agent.failure.as_ref().map(|why| (&agent.device, why)));
    let failed: Vec<String> = failed.map(|(device, why)| format!("{device} failed: {why}")).collect();
    if !failed.is_empty() {
        bail!("the global model lacks the models of some agents: {}", failed.join("; "));
    }
    if let Some(why) = &report.whole.survey_failure {
        bail!("the survey failed: {why}");
    }
    Ok(())
}

/// What a mission may take beside its page, bytes.
fn merge_memory(bytes: u64, has_page: bool) -> Result<u64> {
    if !has_page {
        return Ok(bytes);
    }
    let least = PAGE_BYTES + MERGE_BYTES_MIN;
    ensure!(
        bytes >= least,
        "--merge-memory: with --http, give at least {}: {} of it are for the page",
        format_bytes(least),
        format_bytes(PAGE_BYTES)
    );
    Ok(bytes - PAGE_BYTES)
}

/// Makes a dataset of photographs, and returns its folder. One that is there already is used.
fn ingest(
    agent: &Path,
    photographs: &Path,
    data: &Path,
    geoid: Option<&Path>,
    json: bool,
) -> Result<PathBuf> {
    if data.is_dir() && Dataset::open(data).is_ok() {
        return Ok(data.to_owned());
    }
    if !agent.is_file() {
        return Err(MissionError::NoAgent { path: agent.to_owned() }.into());
    }
    let mut command = std::process::Command::new(agent);
    command.arg("ingest").arg(photographs).arg("--out").arg(data).args(json.then_some("--json"));
    command.args(geoid.into_iter().flat_map(|grid| [Path::new("--geoid"), grid]));
    let status = command.status().with_context(|| agent.display().to_string())?;
    ensure!(status.success(), "no dataset could be made of {}; see above", photographs.display());
    Ok(data.to_owned())
}

/// Long side of the pictures to train on, pixels, of photographs in the dataset `data`; tells if that makes them smaller.
fn training_px(data: &Path, asked_px: Option<u32>) -> Result<u32> {
    if let Some(px) = asked_px {
        return Ok(px);
    }
    let sides_px = Dataset::open(data)?.views.into_iter().flat_map(|view| view.camera.size_px);
    let largest_px = sides_px.max().unwrap_or(0);
    if largest_px > PHOTOGRAPHS_PX {
        writeln!(
            io::stderr(),
            "pictures of {largest_px} pixels are trained at {PHOTOGRAPHS_PX}; --max-size sets another size"
        )?;
    }
    Ok(PHOTOGRAPHS_PX)
}

fn division(args: &MissionArgs) -> Result<Division> {
    match (&args.grid, &args.cells) {
        (Some(grid), _) => Ok(grid.clone()),
        (None, Some(file)) => {
            let cells = read_cells(file).context("--cells")?;
            Ok(Division::Polygons(cells.into_iter().map(|cell| cell.corners).collect()))
        }
        (None, None) => Ok(Division::Evenly { agents: usize::from(args.agents) }),
    }
}

fn parse_grid(text: &str) -> Result<Division, String> {
    let count = |text: &str| text.parse().ok().filter(|count| (1..=99).contains(count));
    let counts = text.split_once('x').and_then(|(columns, rows)| Some((count(columns)?, count(rows)?)));
    let (columns, rows) = counts.ok_or("write a grid as COLUMNSxROWS, for example 3x2, up to 99x99")?;
    Ok(Division::Grid { columns, rows })
}

fn parse_margin(text: &str) -> Result<f64, String> {
    let margin: f64 = text.parse().map_err(|error| format!("{error}"))?;
    if (0.0..=1.0).contains(&margin) { Ok(margin) } else { Err("give a number from 0 to 1".into()) }
}

/// Settings of the default city. Each seed of a mission gives another city.
fn city_of_seed(seed: u64) -> CitySettings {
    let usual = CitySettings::default();
    CitySettings { seed: usual.seed.wrapping_add(seed), ..usual }
}

fn print_report(report: &MissionReport, out: &Path, json: bool) -> Result<()> {
    let mut stdout = io::stdout().lock();
    if json {
        let line = serde_json::json!({"event": "report", "report": report});
        writeln!(stdout, "{line}")?;
        return Ok(());
    }
    writeln!(stdout, "\n{}", table(report))?;
    let mesh = report.whole.mesh.map(|_| "mesh.ply");
    for file in ["global.ply"].into_iter().chain(mesh).chain(["report.html", "report.json"]) {
        writeln!(stdout, "{}", out.join(file).display())?;
    }
    Ok(())
}

fn surroundings(json: bool) -> Result<Surroundings> {
    let begun = Instant::now();
    let interrupted = Arc::new(AtomicBool::new(false));
    let flag = interrupted.clone();
    ctrlc::set_handler(move || flag.store(true, Ordering::SeqCst))
        .context("cannot install the Ctrl-C handler")?;
    let executable = std::env::current_exe().context("cannot find the path of this program")?;
    Ok(Surroundings {
        now: Arc::new(move || begun.elapsed()),
        session: session(),
        cores: cores(),
        agent: executable.with_file_name(format!("cosurf-agent{}", std::env::consts::EXE_SUFFIX)),
        display: display(json),
        board: None,
        interrupted,
        peak_memory_bytes: || Some(usage::peak_bytes()).filter(|bytes| *bytes > 0),
    })
}
