//! Measures what Local Model Compression (LMC) and distillation by the Model Aggregation Scheme (MAS) gain, and how
//! the number of agents and edges (edge aggregators) changes the result (CoSurfGS, "Ablations of Model Aggregation
//! Scheme", "Ablations of Local Model Compression", "Numbers of Edges and Devices").
//!
//! `cargo bench -p cosurf-tests --bench merging -- --help`
//!
//! All missions take the same number of training steps in total, which is divided evenly among the agents. Agents run
//! side by side, so they are timed by CPU time; merges are timed by wall time. To compare the two, run the bench on
//! one core (`taskset -c 0 COMMAND`). The last column adds the times of the slowest agent, the slowest edge and the
//! last merge, as a percentage of the training time of the mission with one agent. The default dataset is
//! `../shared/data/gt_boruszyn`, relative to the checkout. If it is missing, the bench uses a small synthetic city.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Result, ensure};
use clap::Parser;
use cosurf_aggregator::evaluate::accuracy;
use cosurf_aggregator::report::MissionReport;
use cosurf_scene::{Dataset, Mesh};
use cosurf_tests::datasets::{default_dataset, true_surface};
use cosurf_tests::programs::program;
use cosurf_tests::results::{Better, Column, Measurement, Tolerance};

const EVAL_EVERY: u32 = 8;

/// Compare ways of merging. Prints a table, and writes JSON to target/results.
#[derive(Parser)]
struct Arguments {
    /// Folder of a dataset; F-scores need its true surface, gt/points.ply or gt/mesh.ply [default: gt_boruszyn or a
    /// city]
    #[arg(long, value_name = "DATA")]
    data: Option<PathBuf>,
    /// Shrink pictures until their long side is at most this many pixels
    #[arg(long, value_name = "PX", default_value_t = 240)]
    max_size: u32,
    /// Training steps for each view, on average
    #[arg(long, value_name = "N", default_value_t = 40)]
    steps_per_view: usize,
    /// Largest distance from the true surface that counts as correct, metres
    #[arg(long, value_name = "M", default_value_t = 0.5)]
    threshold: f64,
    /// Folder of the LPIPS weights
    #[arg(long, value_name = "FOLDER")]
    lpips: Option<PathBuf>,
    /// Passed by cargo to every bench
    #[arg(long, hide = true)]
    bench: bool,
}

/// A mission to measure. `agents` is the number of agents of each edge, or of the mission if it has no edges.
struct Variant {
    name: &'static str,
    edges: usize,
    agents: usize,
    options: &'static [&'static str],
}

const VARIANTS: [Variant; 9] = [
    Variant { name: "1 agent", edges: 0, agents: 1, options: &["--epochs", "0", "--no-compress"] },
    Variant { name: "4 agents, joined", edges: 0, agents: 4, options: &["--epochs", "0", "--no-compress"] },
    Variant { name: "4 agents, LMC", edges: 0, agents: 4, options: &["--epochs", "0"] },
    Variant { name: "4 agents, MAS", edges: 0, agents: 4, options: &["--no-compress"] },
    Variant { name: "4 agents, LMC and MAS", edges: 0, agents: 4, options: &[] },
    Variant { name: "4 agents, LMC and MAS, margin 0.1", edges: 0, agents: 4, options: &["--margin", "0.1"] },
    Variant { name: "2 edges of 2 agents", edges: 2, agents: 2, options: &[] },
    Variant { name: "9 agents", edges: 0, agents: 9, options: &[] },
    Variant { name: "3 edges of 3 agents", edges: 3, agents: 3, options: &[] },
];

fn main() -> Result<()> {
    let arguments = Arguments::parse();
    let folder = tempfile::tempdir()?;
    let data = arguments.data.clone().unwrap_or_else(|| default_dataset(&folder.path().join("city")));
    let truth = true_surface(&data).map(|file| Mesh::read(&file)).transpose()?;
    let views = Dataset::open(&data)?.split(EVAL_EVERY).0.len();
    println!(
        "{}, long side {} px, every view {} times, threshold {} m\n",
        data.display(),
        arguments.max_size,
        arguments.steps_per_view,
        arguments.threshold
    );
    let mut measurement = Measurement::start("merging", &columns());
    let mut alone_s = None;
    for (i, variant) in VARIANTS.iter().enumerate() {
        let out = folder.path().join(i.to_string());
        let report = fly(&arguments, variant, &data, views, &out)?;
        let f_score = truth.as_ref().map(|truth| f_score(&out, truth, arguments.threshold)).transpose()?;
        let times = Times::of(&report);
        let alone_s = *alone_s.get_or_insert(times.agent_s);
        measurement.row(variant.name, &figures(&report, f_score, &times, alone_s));
    }
    measurement.finish()?;
    Ok(())
}

fn fly(
    arguments: &Arguments,
    variant: &Variant,
    data: &Path,
    views: usize,
    out: &Path,
) -> Result<MissionReport> {
    let Variant { name, edges, agents, options } = variant;
    let parts = edges.max(&1) * agents;
    let steps = (arguments.steps_per_view * views).div_ceil(parts);
    let mut command = Command::new(program("cosurf-aggregator"));
    command.args(["mission", "--data"]).arg(data).arg("--out").arg(out).args(*options);
    for (option, value) in [
        ("--edges", edges.to_string()),
        ("--agents", agents.to_string()),
        ("--steps", steps.to_string()),
        ("--max-size", arguments.max_size.to_string()),
        ("--eval-every", EVAL_EVERY.to_string()),
    ] {
        command.args([option, &value]);
    }
    if let Some(lpips) = &arguments.lpips {
        command.arg("--lpips").arg(lpips);
    }
    let output = command.stdin(Stdio::null()).stdout(Stdio::null()).output()?;
    ensure!(output.status.success(), "{name}: {}", String::from_utf8_lossy(&output.stderr));
    Ok(serde_json::from_slice(&std::fs::read(out.join("report.json"))?)?)
}

fn f_score(out: &Path, truth: &Mesh, threshold_m: f64) -> Result<f64> {
    let (accuracy, _) = accuracy::judge(&Mesh::read(&out.join("mesh.ply"))?, truth, threshold_m, 0)?;
    Ok(accuracy.samples.f_score)
}

/// Time of the slowest agent (CPU time), of the slowest edge's merge and of the last merge (wall time), seconds.
struct Times {
    agent_s: f64,
    edge_s: Option<f64>,
    merge_s: Option<f64>,
}

impl Times {
    fn of(report: &MissionReport) -> Self {
        let agents = report.agents.iter().filter_map(|agent| Some(agent.training.as_ref()?.cpu_seconds));
        let edges = report.edges.iter().filter_map(|edge| Some(edge.merging.as_ref()?.seconds));
        Self {
            agent_s: agents.fold(0.0, f64::max),
            edge_s: edges.reduce(f64::max),
            merge_s: report.whole.merging.as_ref().map(|merging| merging.seconds),
        }
    }

    fn together_s(&self) -> f64 {
        self.agent_s + self.edge_s.unwrap_or(0.0) + self.merge_s.unwrap_or(0.0)
    }
}

fn columns() -> [Column; 10] {
    let time = |name| Column::speed(name, "s", 0, Better::Lower);
    [
        Column::psnr("PSNR"),
        Column::ssim(),
        Column::new("LPIPS", "", 3).guarded(Better::Lower, Tolerance::Absolute(0.01)),
        Column::f_score(),
        Column::splats(),
        Column::new("sent", "MiB", 2).guarded(Better::Lower, Tolerance::Relative(0.05)),
        time("slowest agent"),
        time("slowest edge"),
        time("last merge"),
        Column::speed("together", "% of 1 agent", 0, Better::Lower),
    ]
}

fn figures(report: &MissionReport, f_score: Option<f64>, times: &Times, alone_s: f64) -> [Option<f64>; 10] {
    let whole = &report.whole;
    let quality = whole.quality;
    let bytes = whole.bytes_sent + report.edges.iter().map(|edge| edge.bytes_sent).sum::<u64>();
    [
        quality.map(|quality| quality.psnr),
        quality.map(|quality| quality.ssim),
        quality.and_then(|quality| quality.lpips).map(|lpips| lpips.vgg),
        f_score,
        Some(whole.splats as f64),
        Some(bytes as f64 / f64::from(1 << 20)),
        Some(times.agent_s),
        times.edge_s,
        times.merge_s,
        Some(100.0 * times.together_s() / alone_s.max(1e-9)),
    ]
}
